// The data of the page, what is shown now, and what holds at a moment.

const data = JSON.parse(byId("data").textContent);
const robots = data.robots;
const bodies = data.motion ? data.motion.bodies : [];
const bodyOf = robots.map((robot) => bodies.find((body) => body.name === robot.name));
const TRUSTED = "ok";

const state = {
  k: data.t.length - 1, // the index of the moment
  playing: false,
  shown: robots.map(() => true),
  chosen: Math.max(0, robots.findIndex((robot) => robot.status !== TRUSTED)),
  layers: {},
  measure: "diameter",
  facet: null, // under the pointer: {robot, row, t}
};

// Okabe and Ito's colours for the colour-blind, with a lighter last pair on dark paper.
const LIGHT = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B07A00", "#3C9BD0", "#7F5539", "#4D4D4D"];
const DARK = ["#4FA8DE", "#F0803A", "#2FC398", "#E09CC4", "#E6B23C", "#8CCBF0", "#C99A78", "#B9BEC4"];
const CASES = { A: "no active row", B: "one", C: "several, parallel", D: "two", E: "three or more" };
const dark = window.matchMedia("(prefers-color-scheme: dark)");

const colour = (i) => (dark.matches ? DARK : LIGHT)[i % LIGHT.length];
/** Beyond eight robots the colours come again, with dashes. */
const dashes = (i) => [[], [6, 3], [2, 2], [8, 3, 2, 3]][Math.floor(i / LIGHT.length) % 4];
const paper = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const caseColour = (letter) =>
  (dark.matches ? ["#2f3a46", "#40597a", "#5380ad", "#76aede", "#c4e1ff"] : ["#edf1f5", "#bfd0e3", "#86a9cc", "#467bb0", "#173f6d"])["ABCDE".indexOf(letter)];

/** The index of the last time not after t, -1 if there is none. */
function last(times, t) {
  let low = -1, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + 1e-9) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** The index of the sample nearest to t. */
function nearest(t) {
  const k = Math.max(0, last(data.t, t));
  return k + 1 < data.t.length && data.t[k + 1] - t < t - data.t[k] ? k + 1 : k;
}

const now = () => data.t[state.k];
const setTimes = robots.map((robot) => robot.sets.map((set) => set[0]));

/** The set of a robot that is known at t, null before the first. */
function setAt(i, t) {
  return robots[i].sets[last(setTimes[i], t)] ?? null;
}

/** The status of a robot at t: ok, alarm or inconsistent. */
function statusAt(i, t) {
  const statuses = robots[i].statuses;
  return statuses[Math.max(0, last(statuses.map(([since]) => since), t))][1];
}

/** The index of motion at t, and the position of a body then (null if it is not seen). */
const moment = (t) => (data.motion ? Math.max(0, last(data.motion.t, t)) : -1);
const placeOf = (body, t) => (body ? body.x[moment(t)] : null);

/** Names of the rows that are active at t. */
function activeAt(i, t) {
  const body = bodyOf[i];
  return body && body.active ? body.active[moment(t)].map((name) => data.names[name]) : [];
}

const shadows = new WeakMap();

/** The shadow of a set on two of its axes: the convex hull, as indices of vertices in order. */
function shadow(set, [a, b]) {
  const key = `${a}${b}`;
  if (!shadows.has(set)) shadows.set(set, {});
  return (shadows.get(set)[key] ??= hull(set[1], a, b));
}

function hull(points, a, b) {
  const order = points.map((_, i) => i).sort((i, j) => points[i][a] - points[j][a] || points[i][b] - points[j][b]);
  if (order.length < 3) return order;
  const turn = (i, j, k) =>
    (points[j][a] - points[i][a]) * (points[k][b] - points[i][b]) - (points[j][b] - points[i][b]) * (points[k][a] - points[i][a]);
  const half = (list) => {
    const chain = [];
    for (const i of list) {
      while (chain.length > 1 && turn(chain.at(-2), chain.at(-1), i) <= 0) chain.pop();
      chain.push(i);
    }
    return chain.slice(0, -1);
  };
  return [...half(order), ...half(order.reverse())];
}

/** The facets on which two vertices of a set lie: [name, time] each. */
function facetsBetween(set, i, j) {
  return set[2][i].filter((facet) => set[2][j].includes(facet)).map((facet) => set[3][facet]);
}

const listeners = [];
let waiting = false;

/** Draw everything again in the next frame. */
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    const began = performance.now();
    for (const draw of listeners) draw();
    state.frame = performance.now() - began;
    state.frames = (state.frames ?? 0) + 1;
  });
}

/** Go to a moment, given by its index. */
function go(k) {
  state.k = Math.min(data.t.length - 1, Math.max(0, k));
  redraw();
}
