// The course of the run: the size of every set, and the case of every robot, over time.

const ends = [data.t[0], data.t.at(-1) > data.t[0] ? data.t.at(-1) : data.t[0] + 1];
const sameUnit = new Set(data.units).size === 1 ? data.units[0] : "";
const volumeUnit = sameUnit && sameUnit + ["", "", "²", "³"][data.dim];
const sizeUnit = () => (state.measure === "diameter" ? sameUnit : volumeUnit);
const MEASURES = { diameter: "diameter", volume: ["", "length", "area", "volume"][data.dim] ?? "volume" };

/** Room for the names of the robots, the same in both charts so that their times are one below the other. */
const gutter = (() => {
  const pen = document.createElement("canvas").getContext("2d");
  pen.font = `11px ${FONT}`;
  const widest = Math.max(...robots.map((robot) => pen.measureText(short(robot.name)).width));
  return () => Math.max(64, Math.min(110, widest + 12));
})();

function cursor(chart, pen) {
  const x = chart.px(now());
  pen.strokeStyle = paper("accent");
  pen.lineWidth = 1.6;
  line(pen, x, chart.top - 4, x, chart.height - chart.foot);
  trace(pen, [[x - 5, chart.top - 7], [x + 5, chart.top - 7], [x, chart.top]]);
  pen.fillStyle = paper("accent");
  pen.fill();
}

/** The first time at which a robot was not trusted, null if there was none. */
const doubted = (i) => robots[i].statuses.find(([, status]) => status !== TRUSTED)?.[0] ?? null;

function sizeRange() {
  const values = shownRobots().flatMap((i) => robots[i][state.measure].filter((v) => v > 0));
  const [low, high] = [values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), 0)];
  return values.length ? [low / 1.25, high * 1.25] : [0.1, 10];
}

function sizeY(chart, value) {
  const [low, high] = chart.bounds, share = Math.log(Math.max(value, low) / low) / Math.log(high / low);
  return chart.height - chart.foot - share * (chart.height - chart.foot - chart.top);
}

function paintSizes(chart, pen) {
  chart.bounds = sizeRange();
  chart.xAxis(pen, "t [s]");
  for (const value of logTicks(...chart.bounds)) chart.yTick(pen, sizeY(chart, value), quantity(value, sizeUnit() === "m" ? "m" : ""));
  pen.lineJoin = "round";
  for (const i of shownRobots()) {
    const since = doubted(i), values = robots[i][state.measure];
    const until = since === null ? data.t.length : nearest(since) + 1;
    curve(chart, pen, values, 0, until, colour(i), dashes(i), 1.7);
    if (since === null) continue;
    curve(chart, pen, values, until - 1, data.t.length, paper("grey"), [3, 3], 1.4);
    const [x, y] = [chart.px(since), sizeY(chart, values[until - 1] ?? chart.bounds[0])];
    pen.strokeStyle = paper("bad");
    pen.lineWidth = 2;
    line(pen, x - 4, y - 4, x + 4, y + 4);
    line(pen, x - 4, y + 4, x + 4, y - 4);
  }
}

function curve(chart, pen, values, from, until, ink, dash, width) {
  pen.strokeStyle = ink;
  pen.lineWidth = width;
  pen.setLineDash(dash);
  pen.beginPath();
  for (let k = from; k < until; k++) {
    if (values[k] === null) continue;
    const [x, y] = [chart.px(data.t[k]), sizeY(chart, values[k])];
    if (k === from || values[k - 1] === null) pen.moveTo(x, y);
    else pen.lineTo(x, y);
  }
  pen.stroke();
  pen.setLineDash([]);
}

const sizes = new Chart(byId("sizes"), {
  left: gutter,
  range: () => ends,
  key: () => [state.shown, state.measure],
  paint: paintSizes,
  above(chart, pen) {
    cursor(chart, pen);
    for (const i of shownRobots()) {
      const value = robots[i][state.measure][state.k];
      if (value === null) continue;
      pen.lineWidth = 1.5;
      disc(pen, [chart.px(now()), sizeY(chart, value)], i === state.chosen ? 4.5 : 3, statusAt(i, now()) === TRUSTED ? colour(i) : paper("grey"), paper("panel"));
    }
  },
  lines(x, y) {
    const t = sizes.value(x), k = nearest(t);
    const near = shownRobots()
      .filter((i) => robots[i][state.measure][k] !== null)
      .map((i) => [Math.abs(sizeY(sizes, robots[i][state.measure][k]) - y), i])
      .sort(([a], [b]) => a - b)[0];
    if (!near || near[0] > 18) return null;
    const i = near[1], trusted = statusAt(i, data.t[k]) === TRUSTED;
    return [robots[i].name, `${MEASURES[state.measure]} ${quantity(robots[i][state.measure][k], sizeUnit())} at ${seconds(data.t[k])}`, ...(trusted ? [] : ["not trusted"])];
  },
  pick: (t) => go(nearest(t)),
});

const laneHeight = () => Math.max(4, Math.min(20, 420 / robots.length));
byId("lanes").style.height = `${Math.round(robots.length * laneHeight() + 44)}px`;

function paintLanes(chart, pen) {
  const tall = laneHeight(), bottom = chart.height - chart.foot, end = data.t.at(-1);
  chart.xAxis(pen, "t [s]");
  robots.forEach((robot, i) => {
    const y = chart.top + i * tall;
    pen.globalAlpha = state.shown[i] ? 1 : 0.25;
    for (let from = 0, k = 1; k <= data.t.length; k++) {
      if (k < data.t.length && robot.case[k] === robot.case[from]) continue;
      const ink = caseColour(robot.case[from]);
      if (ink) {
        const [left, right] = [chart.px(data.t[from]), chart.px(k < data.t.length ? data.t[k] : end)];
        pen.fillStyle = ink;
        pen.fillRect(left, y, Math.max(right - left, 0.7), tall - (tall > 7 ? 3 : 0));
      }
      from = k;
    }
    const since = doubted(i);
    if (since !== null) {
      const [left, right] = [chart.px(since), chart.px(end)];
      hatch(pen, [[left, y], [right, y], [right, y + tall - 3], [left, y + tall - 3]], paper("bad"));
    }
    pen.globalAlpha = 1;
    if (tall < 10) return;
    pen.font = `${i === state.chosen ? 700 : 400} 11px ${FONT}`;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.fillStyle = state.shown[i] ? colour(i) : paper("grey");
    pen.fillText(short(robot.name), chart.left - 6, y + tall / 2 - 1);
  });
  pen.strokeStyle = paper("line");
  line(pen, chart.left, bottom, chart.width - chart.right, bottom);
}

const laneAt = (y) => Math.floor((y - lanes.top) / laneHeight());
const lanes = new Chart(byId("lanes"), {
  left: gutter,
  range: () => ends,
  key: () => [state.shown, state.chosen],
  paint: paintLanes,
  above: cursor,
  lines(x, y) {
    const robot = robots[laneAt(y)], k = nearest(lanes.value(x));
    if (!robot) return null;
    const letter = robot.case[k], doubt = doubted(laneAt(y));
    const words = letter === " " ? "not measured" : `case ${letter}: ${CASES[letter]}`;
    return [robot.name, `${words}, at ${seconds(data.t[k])}`, ...(doubt !== null && data.t[k] >= doubt ? ["its set is not trusted"] : [])];
  },
  pick: (t) => go(nearest(t)),
});
