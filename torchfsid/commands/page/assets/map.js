// What the planes show: bodies that move, sets and estimates, active rows, contradictions.

const icon = (content) => `<svg viewBox="0 0 20 14" aria-hidden="true" fill="none" stroke="currentColor" stroke-width="1.8">${content}</svg>`;
const few = robots.length <= 5;
const has = (name) => robots.some((robot) => robot[name]);

/** The layers of the map: name, words, picture, whether there is anything to show, whether it is shown at first. */
const LAYERS = [
  ["paths", "paths", icon('<path d="M1 11C6 1 12 14 19 3"/>'), bodies.length, true],
  ["sets", "sets Θ(t)", icon('<path d="M3 9 8 2l9 3-3 7-7 1z" fill="currentColor" fill-opacity=".25"/>'), has("sets"), true],
  ["prior", "prior", icon('<path d="M2 2h16v10H2z" stroke-dasharray="3 2"/>'), data.prior, true],
  ["centroid", "centroid", icon('<path d="M10 1v12M4 7h12"/>'), has("centroid"), true],
  ["ukf", "filter (UKF)", icon('<path d="m10 1 6 6-6 6-6-6z"/>'), has("ukf"), few],
  ["hybrid", "hybrid", icon('<path d="M5 2h10v10H5z"/>'), has("hybrid"), few],
  ["truth", "truth", icon('<path d="m10 1 1.8 4.2 4.4.3-3.4 3 1 4.4L10 10.5l-3.8 2.4 1-4.4-3.4-3 4.4-.3z" fill="currentColor"/>'), has("truth"), true],
  ["active", "active rows", icon('<path d="M6 2v10M6 7h12"/>'), bodies.some((body) => body.active), true],
  ["velocity", "velocities", icon('<path d="M1 7h16M12 3l5 4-5 4"/>'), bodies.some((body) => body.v.some(Boolean)), few],
  ["names", "names", icon('<path d="M5 12 10 2l5 10M7 8.5h6"/>'), true, robots.length <= 24],
  ["evidence", "contradictions", icon('<path d="m5 2 10 10M15 2 5 12"/>'), robots.some((robot) => robot.evidence.length), true],
];
for (const [name, , , there, first] of LAYERS) state.layers[name] = Boolean(there && first);

const fastest = Math.max(1e-12, ...bodies.flatMap((body) => body.v.filter(Boolean).map((v) => Math.hypot(...v))));

/** Draw bodies and their paths. */
function paintMotion(plane, pen, who) {
  const t = now(), k = moment(t);
  bodies.forEach((body) => {
    const i = robots.findIndex((robot) => robot.name === body.name), ink = i < 0 ? paper("grey") : colour(i);
    if (i >= 0 && !who.includes(i)) return;
    if (state.layers.paths && i >= 0) {
      pen.setLineDash(dashes(i));
      path(plane, pen, body.x, body.x.length - 1, ink, 0.28, 1.2);
      path(plane, pen, body.x, k, ink, 0.95, 1.7);
      pen.setLineDash([]);
    }
    const x = body.x[k];
    if (!x) return;
    const at = plane.px(x), size = Math.max(i < 0 ? 5 : 4, (body.radius ?? 0) * plane.camera.sx);
    if (i < 0 && data.keep_out) {
      pen.setLineDash([2, 3]);
      pen.lineWidth = 1;
      disc(pen, at, data.keep_out * plane.camera.sx, null, ink);
      pen.setLineDash([]);
    }
    pen.globalAlpha = i < 0 ? 0.55 : 0.9;
    disc(pen, at, size, ink);
    pen.globalAlpha = 1;
    if (state.layers.velocity && i >= 0 && body.v[k]) {
      const [a, b] = plane.axes, reach = 42 / fastest;
      pen.strokeStyle = ink;
      pen.lineWidth = 2;
      arrow(pen, at, [at[0] + body.v[k][a] * reach, at[1] - body.v[k][b] * reach]);
    }
    if (state.layers.names) label(pen, short(body.name), at[0] + size + 4, at[1] - size - 2, i < 0 ? paper("muted") : ink);
    const lines = [body.name, `at ${point(x, 0.01, "m")}`, body.v[k] ? `${plain(Math.hypot(...body.v[k]))} m/s` : "velocity unknown"];
    if (body.radius) lines.push(`radius ${quantity(body.radius, "m")}`);
    if (i >= 0 && body.active) lines.push(`active rows: ${activeAt(i, t).join(", ") || "none"}`);
    plane.hits.push({ from: at, to: at, reach: size + 4, first: 2, lines });
  });
}

function path(plane, pen, points, until, ink, alpha, width) {
  pen.beginPath();
  let open = false;
  for (let k = 0; k <= until; k++) {
    if (points[k]) {
      const [x, y] = plane.px(points[k]);
      if (open) pen.lineTo(x, y);
      else pen.moveTo(x, y);
    }
    open = Boolean(points[k]);
  }
  pen.globalAlpha = alpha;
  pen.strokeStyle = ink;
  pen.lineWidth = width;
  pen.lineJoin = "round";
  pen.stroke();
  pen.globalAlpha = 1;
}

/** Draw the rows that are active now: a line to the body that is avoided, an arrow to a wall, a ring for a speed. */
function paintActive(plane, pen, who) {
  const t = now();
  pen.strokeStyle = paper("ink");
  pen.setLineDash([]);
  for (const i of who) {
    const x = placeOf(bodyOf[i], t);
    if (!x) continue;
    const at = plane.px(x), clear = Math.max(4, (bodyOf[i].radius ?? 0) * plane.camera.sx) + 4;
    for (const row of activeAt(i, t)) {
      const other = row.startsWith("avoid ") && bodies.find((body) => body.name === row.slice(6));
      const wall = /([+-])([xyz])$/.exec(row);
      let to = other ? placeOf(other, t) && plane.px(placeOf(other, t)) : null;
      if (!to && wall) {
        const along = plane.axes.indexOf("xyz".indexOf(wall[2])), sign = wall[1] === "+" ? 1 : -1;
        if (along < 0) continue;
        to = [at[0] + (along === 0 ? sign * (clear + 16) : 0), at[1] - (along === 1 ? sign * (clear + 16) : 0)];
      }
      pen.lineWidth = 1.4;
      if (!to) {
        disc(pen, at, clear, null, paper("ink"));
        continue;
      }
      const far = Math.hypot(to[0] - at[0], to[1] - at[1]) || 1, [dx, dy] = [(to[0] - at[0]) / far, (to[1] - at[1]) / far];
      const foot = [at[0] + dx * clear, at[1] + dy * clear];
      if (other) {
        line(pen, ...foot, ...to);
        plane.hits.push({ from: foot, to, reach: 5, lines: [`${robots[i].name}: ${row}`, "this row is active now"] });
      } else arrow(pen, foot, to);
      pen.lineWidth = 3;
      line(pen, foot[0] - 7 * dy, foot[1] + 7 * dx, foot[0] + 7 * dy, foot[1] - 7 * dx);
    }
  }
}

/** Draw the prior box. */
function paintPrior(plane, pen) {
  const [low, high] = data.prior, [a, b] = plane.axes;
  const corner = (x, y) => { const at = [...low]; at[a] = x; at[b] = y; return plane.px(at); };
  pen.strokeStyle = paper("muted");
  pen.lineWidth = 1.2;
  pen.setLineDash([5, 4]);
  trace(pen, [corner(low[a], low[b]), corner(high[a], low[b]), corner(high[a], high[b]), corner(low[a], high[b])]);
  pen.stroke();
  pen.setLineDash([]);
}

/** Draw the sets of these robots; a set that is not trusted is grey and hatched. */
function paintSets(plane, pen, who, named) {
  const t = now();
  for (const i of who) {
    const set = setAt(i, t), ink = colour(i), trusted = statusAt(i, t) === TRUSTED;
    if (!set || !set[1].length) continue;
    const order = shadow(set, plane.axes), outline = order.map((k) => plane.px(set[1][k]));
    const xs = outline.map(([x]) => x), ys = outline.map(([, y]) => y);
    const wide = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys));
    trace(pen, outline);
    pen.fillStyle = trusted ? ink : paper("grey");
    pen.globalAlpha = trusted ? (who.length > 6 ? 0.12 : 0.2) : 0.14;
    pen.fill();
    pen.globalAlpha = 1;
    if (!trusted) hatch(pen, outline, paper("grey"));
    pen.setLineDash(trusted ? [] : [5, 4]);
    pen.strokeStyle = ink;
    pen.lineWidth = 1.7;
    trace(pen, outline);
    pen.stroke();
    pen.setLineDash([]);
    const middle = [(Math.max(...xs) + Math.min(...xs)) / 2, (Math.max(...ys) + Math.min(...ys)) / 2];
    const what = trusted ? [] : [`not trusted: ${statusAt(i, t)}`];
    const size = robots[i].diameter[state.k];
    const about = [`${robots[i].name}: set of diameter ${quantity(size, sameUnit)}`, ...what];
    if (wide < 9) {
      pen.lineWidth = 1.5;
      disc(pen, middle, 9, null, trusted ? ink : paper("grey"));
      plane.hits.push({ from: middle, to: middle, reach: 11, lines: [...about, "choose the robot to see it enlarged"] });
    } else outline.forEach((from, k) => edge(plane, pen, i, set, order, k, from, outline[(k + 1) % outline.length]));
    if (named && state.layers.names) {
      const x = placeOf(bodyOf[i], t), home = x ? plane.px(x) : [-99, -99];
      const text = short(robots[i].name) + (trusted ? "" : " (not trusted)");
      if (Math.hypot(home[0] - middle[0], home[1] - middle[1]) > 40) label(pen, text, middle[0] + 11, middle[1] + 10, ink, { weight: 500 });
    }
  }
}

function edge(plane, pen, i, set, order, k, from, to) {
  const found = facetsBetween(set, order[k], order[(k + 1) % order.length]);
  if (!found.length) return;
  const facet = { robot: i, row: found[0][0], t: found[0][1] }, here = state.facet;
  if (here && here.robot === i && here.row === facet.row && here.t === facet.t) {
    pen.strokeStyle = colour(i);
    pen.lineWidth = 5;
    line(pen, ...from, ...to);
  }
  const lines = found.flatMap(([name, time]) =>
    time === null ? [data.names[name], "declared, not measured"] : [data.names[name], `measured at ${seconds(time)}`]);
  plane.hits.push({ from, to, facet, first: 1, lines: [`${robots[i].name}: ${lines[0]}`, ...lines.slice(1)] });
}

/** Draw the point estimates of these robots, and the truth. */
function paintEstimates(plane, pen, who) {
  for (const i of who) {
    for (const name of ["truth", "ukf", "hybrid", "centroid"]) {
      const robot = robots[i], at = name === "truth" ? robot.truth : robot[name]?.[state.k];
      if (!state.layers[name] || !at || at.includes(null)) continue;
      const place = plane.px(at);
      mark(pen, name, place, name === "truth" ? paper("ink") : colour(i), name === "truth" ? 7 : 6);
      const words = { truth: "true " + data.place, ukf: "filter (UKF)", hybrid: "hybrid", centroid: "centroid" }[name];
      const size = robot.diameter[state.k] ?? 0.01;
      plane.hits.push({ from: place, to: place, reach: 8, lines: [`${robot.name}: ${words}`, point(at, size / 10, data.units[0])] });
    }
  }
}

/** Where the robot was at the samples that contradict each other, numbered as in the verdict. */
function paintEvidence(plane, pen, who) {
  for (const i of who) {
    robots[i].evidence.forEach((event) => {
      if (event.t > now() + 1e-9) return;
      event.samples.forEach((sample, number) => {
        const x = sample.t === null ? null : placeOf(bodyOf[i], sample.t);
        if (!x) return;
        const [px, py] = plane.px(x), bold = i === state.chosen;
        for (const [ink, width] of [[paper("panel"), 5], [paper("bad"), 2.2]]) {
          pen.strokeStyle = ink;
          pen.lineWidth = width;
          line(pen, px - 5, py - 5, px + 5, py + 5);
          line(pen, px - 5, py + 5, px + 5, py - 5);
        }
        if (bold) label(pen, String(number + 1), px + 9 + 9 * (number % 2), py + 9, paper("bad"));
        plane.hits.push({ from: [px, py], to: [px, py], reach: 8, first: 3, lines: [`${robots[i].name}: ${sample.row} at ${seconds(sample.t)}`, event.what.replace(/:$/, "")] });
      });
    });
  }
}

/** Where the robot was when it showed the facet under the pointer. */
function paintOrigin(plane, pen) {
  if (!state.facet || state.facet.t === null) return;
  const x = placeOf(bodyOf[state.facet.robot], state.facet.t);
  if (!x) return;
  pen.lineWidth = 2.5;
  disc(pen, plane.px(x), 11, null, paper("ink"));
}

const shownRobots = () => robots.map((_, i) => i).filter((i) => state.shown[i]);

/** Everything on the map. */
function paintMap(plane, pen) {
  const who = shownRobots();
  if (data.is_place && state.layers.prior && data.prior) paintPrior(plane, pen);
  if (data.is_place && state.layers.sets) paintSets(plane, pen, who, true);
  paintMotion(plane, pen, who);
  if (state.layers.active) paintActive(plane, pen, who);
  if (data.is_place) paintEstimates(plane, pen, who);
  if (state.layers.evidence) paintEvidence(plane, pen, who);
  paintOrigin(plane, pen);
}

/** Sets and estimates alone: the plane of parameters, or one set enlarged. */
function paintTheta(plane, pen, who, named = false) {
  if (data.is_place && bodies.length) {
    for (const i of who) if (bodyOf[i] && state.layers.paths) path(plane, pen, bodyOf[i].x, moment(now()), colour(i), 0.5, 1.2);
  }
  if (state.layers.prior && data.prior) paintPrior(plane, pen);
  paintSets(plane, pen, who, named);
  paintEstimates(plane, pen, who);
}

/** The least box that holds all points, on two axes. */
function boundsOf(points, [a, b]) {
  const there = points.filter(Boolean);
  return [a, b].map((axis) => there.reduce(([low, high], x) => [Math.min(low, x[axis]), Math.max(high, x[axis])], [Infinity, -Infinity]));
}

/** What the map shows at first: all motion, final sets and truths, and the prior if it is not much larger. */
function mapBounds(axes) {
  const sets = data.is_place ? robots.flatMap((robot) => [...(robot.sets.at(-1)?.[1] ?? []), robot.truth]) : [];
  const points = [...bodies.flatMap((body) => body.x), ...sets].filter(Boolean);
  const prior = data.is_place && data.prior ? data.prior : [];
  if (!points.length) return boundsOf(prior.length ? prior : [data.parameters.map(() => -1), data.parameters.map(() => 1)], axes);
  const width = (list) => Math.max(...list[0].map((_, axis) => boundsOf(list, [axis, axis])[0]).map(([low, high]) => high - low));
  return boundsOf(prior.length && width(prior) < 1.7 * width(points) ? [...points, ...prior] : points, axes);
}

/** The set of the chosen robot now, or the prior. */
function lensBounds(axes) {
  const set = setAt(state.chosen, now());
  if (set && set[1].length) return boundsOf(set[1], axes);
  return data.prior ? boundsOf(data.prior, axes) : [[-1, 1], [-1, 1]];
}

/** All sets of the robots that are shown now. */
function thetaBounds(axes) {
  const points = shownRobots().flatMap((i) => setAt(i, now())?.[1] ?? []);
  return points.length ? boundsOf(points, axes) : lensBounds(axes);
}
