// The panels in words: heading, robots, the chosen robot's verdict, safety parameters, notes.

const WORDS = { ok: "no contradiction", alarm: "alarm", inconsistent: "inconsistent" };

/** A verdict in words. "No contradiction" is never said alone if the bound is useless. */
const verdictOf = (status) => WORDS[status] + (status === TRUSTED && data.useless ? " (bound useless)" : "");
const toneOf = (status) => (status === TRUSTED && !data.useless ? "good" : "bad");

function heading() {
  const counts = Object.keys(WORDS)
    .map((status) => [robots.filter((robot) => robot.status === status).length, verdictOf(status)])
    .filter(([count]) => count);
  byId("title").textContent = data.heading ?? data.title;
  byId("lead").textContent =
    `${robots.length} ${robots.length === 1 ? "robot" : "robots"}, ${data.samples} samples from ${seconds(data.t[0])} to ${seconds(data.t.at(-1))}. ` +
    `Verdicts: ${counts.map(([count, words]) => `${count} ${words}`).join(", ")}.`;
  byId("facts").replaceChildren(...data.model.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value))));
  byId("map-note").textContent = data.is_place ? "dashed: the prior; hatched: a set that is not trusted" : "the parameters are no places: see their sets below";
  byId("cases").replaceChildren(
    ...Object.entries(CASES).map(([letter, words]) => {
      const box = element("i");
      box.style.background = caseColour(letter);
      return element("span", {}, box, `${letter} ${words}`);
    }),
    ...(robots.some((_, i) => doubted(i) !== null) ? [element("span", { className: "bad" }, "hatched: after a contradiction")] : []));
  byId("size-head").textContent = MEASURES[state.measure];
  byId("size-unit").textContent = sizeUnit() && sizeUnit() !== "m" ? `[${sizeUnit()}]` : "";
  byId("point-head").textContent = data.is_place ? "centroid [m]" : `centroid (${data.parameters.join(", ")})`;
}

const swatch = (i) => {
  const made = element("span", { className: "swatch" });
  made.style.background = colour(i);
  return made;
};

const cells = robots.map((robot, i) => {
  const box = element("input", { type: "checkbox", checked: true, "aria-label": `show ${robot.name}`, onchange: () => show(i, box.checked) });
  const cell = { box, size: element("td", { className: "number" }), point: element("td", { className: "wide point" }), rows: element("td", { className: "wide" }) };
  const verdict = element("td", { className: toneOf(robot.status) }, verdictOf(robot.status));
  cell.line = element("tr", { onclick: (event) => { if (event.target !== box) choose(i); } },
    element("td", {}, box), element("td", {}, swatch(i), element("button", { title: "Show its set and verdict below" }, robot.name)),
    verdict, cell.size, cell.point, cell.rows);
  return cell;
});

function show(i, shown) {
  state.shown[i] = shown;
  redraw();
}

function choose(i) {
  state.chosen = i;
  redraw();
}

function table() {
  cells.forEach((cell, i) => {
    cell.box.checked = state.shown[i];
    cell.line.className = i === state.chosen ? "chosen" : "";
    cell.size.textContent = quantity(robots[i][state.measure][state.k], sizeUnit());
    cell.point.textContent = point(robots[i].centroid?.[state.k], robots[i].diameter[state.k]);
    cell.rows.textContent = activeAt(i, now()).join(", ") || "–";
  });
}

let said = null;

/** The verdict of the chosen robot with its evidence, whose times can be gone to. */
function verdict() {
  const i = state.chosen, robot = robots[i];
  if (said !== i) {
    said = i;
    byId("lens-title").textContent = `${robot.name}: its set, enlarged`;
    byId("verdict-title").replaceChildren(swatch(i), `${robot.name}: `, element("span", { className: toneOf(robot.status) }, verdictOf(robot.status)));
    byId("verdict").textContent = robot.meaning + (robot.status === TRUSTED ? "" : " torchfsid check says which rows and bounds do not fit.");
    byId("evidence").replaceChildren(...robot.evidence.map((event) =>
      element("li", { className: event.reset ? "mild" : "" }, "At ", moveTo(event.t), `: ${event.what}`,
        element("ol", {}, ...event.samples.map((sample) => element("li", {}, sample.row, ...(sample.t === null ? [" (declared)"] : [" at ", moveTo(sample.t)])))))));
  }
  const t = now(), untrusted = statusAt(i, t) !== TRUSTED, size = robot.diameter[state.k];
  const set = setAt(i, t);
  byId("lens-note").textContent = !robot.sets.length ? "" : !set ? "not known at this time" : untrusted ? "not trusted" : `${set[3].length} facets; point at one`;
  const values = [
    ["time", seconds(t)],
    ["diameter", quantity(size, sameUnit)],
    [MEASURES.volume, quantity(robot.volume[state.k], volumeUnit)],
    ["centroid", point(robot.centroid?.[state.k], size, "")],
    ["filter (UKF)", robot.ukf && point(robot.ukf[state.k], size, "")],
    ["hybrid", robot.hybrid && point(robot.hybrid[state.k], size, "")],
    [`true ${data.place}`, robot.truth && point(robot.truth, size / 10, "")],
    ["truth at the end", robot.inside === null ? null : robot.inside ? "inside the set" : "outside the set"],
    ["case", robot.case[state.k] === " " ? "not measured" : `${robot.case[state.k]}: ${CASES[robot.case[state.k]]}`],
    ["active rows", activeAt(i, t).join(", ") || "none"],
    ["shrank last", robot.last_cut === null ? "never" : moveTo(robot.last_cut)],
    ["samples not used", robot.skipped ? String(robot.skipped) : null],
    ...robot.told,
  ];
  byId("values").replaceChildren(...values.filter(([, value]) => value).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

const moveTo = (t) => element("button", { title: "Go there", onclick: () => go(nearest(t)) }, seconds(t));

let ofSafety = 0;

function safety() {
  if (!data.safety.length && !data.refutations.length) return;
  byId("safety").hidden = false;
  const choice = byId("safety-of");
  choice.replaceChildren(...data.safety.map((entry, k) => element("option", { value: k }, entry.of)));
  choice.hidden = data.safety.length < 2;
  choice.addEventListener("change", () => { ofSafety = Number(choice.value); words(); redraw(); });
  const words = () => {
    const entry = data.safety[ofSafety];
    byId("safety-values").replaceChildren(element("dt", {}, "of"), element("dd", {}, entry.of),
      ...entry.lines.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
    byId("safety-star").hidden = !entry.starred;
    byId("speeds-note").textContent = "The band holds the true law V(r) if the model is right." + (entry.largest ? ` Dashed: the largest speed in the log, ${plain(entry.largest)} m/s.` : "");
  };
  byId("refutations").replaceChildren(...data.refutations.map((text) => element("p", { className: "bad" }, text)),
    ...(data.odd.length ? [element("p", {}, `Without ${data.odd.length > 1 ? "one of " : ""}${data.odd.join(", ")} the others can have the same parameters.`)] : []));
  if (!data.safety.length) return;
  words();
  speeds();
}

/** V(r): how fast a robot may approach a standing body at distance r. */
function speeds() {
  const rows = () => data.safety[ofSafety].speeds;
  const top = () => Math.min(...[Math.max(...rows().map(([, , high]) => high)), 2.5 * (data.safety[ofSafety].largest || Infinity)]) * 1.08;
  const low = () => Math.min(0, ...rows().map(([, v]) => v));
  const y = (chart, v) => chart.height - chart.foot - ((v - low()) / (top() - low())) * (chart.height - chart.foot - chart.top);
  const chart = new Chart(byId("speeds"), {
    left: () => 52,
    range: () => [rows()[0][0], rows().at(-1)[0]],
    key: () => ofSafety,
    paint(chart, pen) {
      pen.clearRect(0, 0, chart.width, chart.height);
      chart.xAxis(pen, "distance r [m]");
      for (const [value, text] of ticks(low(), top(), 5)) chart.yTick(pen, y(chart, value), text);
      pen.save();
      pen.beginPath();
      pen.rect(chart.left, chart.top, chart.width - chart.left - chart.right, chart.height - chart.foot - chart.top);
      pen.clip();
      const upper = rows().map(([r, , v]) => [chart.px(r), y(chart, v)]), lower = rows().map(([r, v]) => [chart.px(r), y(chart, v)]);
      trace(pen, [...upper, ...[...lower].reverse()]);
      pen.fillStyle = pen.strokeStyle = paper("accent");
      pen.globalAlpha = 0.2;
      pen.fill();
      pen.globalAlpha = 1;
      pen.lineWidth = 1.6;
      for (const side of [upper, lower]) { trace(pen, side, false); pen.stroke(); }
      const largest = data.safety[ofSafety].largest;
      pen.setLineDash([5, 4]);
      pen.strokeStyle = paper("muted");
      if (largest) line(pen, chart.left, y(chart, largest), chart.width, y(chart, largest));
      pen.restore();
      label(pen, "V [m/s]", chart.left + 7, chart.top + 8, paper("muted"), { weight: 500 });
    },
    lines(x) {
      const r = chart.value(x), found = rows().reduce((best, row) => (Math.abs(row[0] - r) < Math.abs(best[0] - r) ? row : best));
      return [`r = ${quantity(found[0], "m")}`, `V from ${plain(found[1])} to ${plain(found[2])} m/s`];
    },
  });
}

function about() {
  byId("notes").replaceChildren(...data.notes.map((note) => element("li", {}, note)));
  byId("config").hidden = data.config === null;
  byId("config").querySelector("pre").textContent = data.config ?? "";
}
