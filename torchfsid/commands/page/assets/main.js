// The page put together: planes, the run of time, keys.

const pairs = { 1: [], 2: [[0, 1]], 3: [[0, 1], [0, 2], [1, 2]] };
const named = (names, units) => ([a, b]) => [a, b].map((axis) => names[axis] + (units[axis] ? ` [${units[axis]}]` : ""));

/** Put planes for all pairs of axes into a panel; three of them are views from three sides. */
function planes(id, axes, names, options) {
  byId(id).classList.toggle("three", axes.length === 3);
  return axes.map((pair, k) => new Plane(byId(id), pair, names(pair), { ...options, big: k === 0, label: `${options.label}, ${names(pair).join(" and ")}` }));
}

const spaces = data.motion ? data.motion.axes : data.is_place ? data.parameters : [];
const parameterNames = named(data.parameters, data.units);
const drawn = robots.some((robot) => robot.sets.length) ? pairs[data.dim] ?? [] : [];
const stretched = new Set(data.units).size > 1 || !data.units[0];
const maps = planes("map", pairs[spaces.length] ?? [], named(spaces, spaces.map(() => "m")), { label: "Map", bounds: mapBounds, paint: paintMap });
const lens = planes("lens", drawn, parameterNames, { label: "The set of the chosen robot", bounds: lensBounds, stretched, paint: (plane, pen) => paintTheta(plane, pen, [state.chosen]) });
if (!data.is_place && drawn.length) {
  byId("theta").hidden = false;
  planes("theta-planes", drawn, parameterNames, { label: "Sets of parameters", bounds: thetaBounds, stretched, paint: (plane, pen) => paintTheta(plane, pen, shownRobots(), true) });
}

byId("layers").append(...LAYERS.filter(([, , , there]) => there).map(([name, words, picture]) => {
  const box = element("input", { type: "checkbox", checked: state.layers[name], onchange: () => { state.layers[name] = box.checked; redraw(); } });
  const text = element("span", { innerHTML: picture });
  text.style.display = "inline-flex";
  return element("label", {}, box, text, words);
}));

byId("measure").append(...Object.entries(MEASURES).map(([value, words]) => element("option", { value }, words)));
byId("measure").addEventListener("change", (event) => { state.measure = event.target.value; heading(); redraw(); });
byId("names").append(...cells.map((cell) => cell.line));
for (const [id, shown] of [["all", true], ["none", false]]) {
  byId(id).addEventListener("click", () => { state.shown.fill(shown); redraw(); });
}

const slider = byId("slider"), play = byId("play");
slider.max = data.t.length - 1;
slider.addEventListener("input", () => { pause(); go(Number(slider.value)); });
play.addEventListener("click", toggle);

function transport() {
  slider.value = state.k;
  slider.setAttribute("aria-valuetext", seconds(now()));
  byId("clock").textContent = seconds(now());
  play.innerHTML = state.playing
    ? '<svg viewBox="0 0 16 16"><path d="M3 2h4v12H3zM9 2h4v12H9z"/></svg>'
    : '<svg viewBox="0 0 16 16"><path d="M3 1.5v13l11-6.5z"/></svg>';
  play.setAttribute("aria-label", state.playing ? "Pause" : "Play");
}

function toggle() {
  if (state.playing) return pause();
  if (state.k === data.t.length - 1) go(0);
  state.playing = true;
  let before = performance.now(), t = now();
  const step = (at) => {
    if (!state.playing) return;
    t += ((Math.max(0, at - before) / 1000) * (data.t.at(-1) - data.t[0])) / Number(byId("speed").value);
    before = at;
    go(Math.max(0, last(data.t, t)));
    if (t >= data.t.at(-1)) pause();
    else requestAnimationFrame(step);
  };
  go(state.k);
  requestAnimationFrame(step);
}

function pause() {
  state.playing = false;
  redraw();
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, pre, summary")) return;
  const step = event.shiftKey ? 10 : 1;
  const target = { ArrowLeft: state.k - step, ArrowRight: state.k + step, Home: 0, End: data.t.length - 1 }[event.key];
  if (event.key === " " && !event.target.closest("button, input[type=checkbox]")) toggle();
  else if (target !== undefined) { pause(); go(target); }
  else return;
  event.preventDefault();
});

listeners.push(transport, table, verdict);
dark.addEventListener("change", () => { heading(); redraw(); });
window.addEventListener("resize", redraw);
heading();
safety();
about();
redraw();

// For the console and for tests.
window.torchfsid = { data, state, go, maps, lens, sizes, lanes };
