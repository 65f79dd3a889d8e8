// A plane of two axes that can be moved and zoomed, with grid and scale.

const FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", Arial, sans-serif';

const TICKS = `11px ${FONT}`;

/** Least room on the left of a plane [px]. */
const LEFT = 46;

/** A canvas in its size on the screen, cleared, in units of CSS pixels. */
function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const [width, height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, box.width, box.height);
  return { pen, width: box.width, height: box.height };
}

/** Round values between low and high, about as many as wanted. */
function ticks(low, high, wanted) {
  const raw = (high - low) / Math.max(1, wanted), power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const digits = Math.min(12, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step && values.length < 100; k++) values.push(k * step);
  return values.map((value) => [value, signed((Math.abs(value) < step / 2 ? 0 : value).toFixed(digits))]);
}

class Plane {
  /**
   * @param parent where the canvas goes
   * @param axes the two axes, by index
   * @param names names of the two axes, with units
   * @param options big: it is the tallest of its panel; bounds(): what `fit` shows, [[low, high], [low, high]];
   *   paint(plane, pen): draws; follows: `fit` is called at every moment
   */
  constructor(parent, axes, names, options) {
    Object.assign(this, { axes, names, options, moved: false, hits: [], left: LEFT });
    this.canvas = element("canvas", { role: "img", "aria-label": options.label });
    const zoom = (factor) => () => this.zoom(factor, this.width / 2, this.height / 2);
    const buttons = element("div", { className: "zoom" },
      element("button", { title: "Zoom in", "aria-label": "Zoom in", onclick: zoom(1.6) }, "+"),
      element("button", { title: "Zoom out", "aria-label": "Zoom out", onclick: zoom(1 / 1.6) }, "−"),
      element("button", { title: "Show everything", onclick: () => { this.moved = false; redraw(); } }, "fit"));
    parent.append(element("div", { className: options.big ? "plane big" : "plane" }, this.canvas, buttons));
    this.listen();
    listeners.push(() => this.draw());
  }

  /** Show the bounds with a margin, the scale equal on both axes unless their units differ. */
  fit() {
    const [x, y] = this.options.bounds(this.axes);
    const [inner, tall] = [this.width - this.left, this.height - this.foot];
    const spread = ([low, high]) => Math.max(high - low, 1e-12 * (1 + Math.abs(low)));
    const scales = [inner / (1.16 * spread(x)), tall / (1.16 * spread(y))];
    if (!this.options.stretched) scales.fill(Math.min(...scales));
    this.camera = { x: (x[0] + x[1]) / 2, y: (y[0] + y[1]) / 2, sx: scales[0], sy: scales[1] };
  }

  /** From the plane to the canvas. */
  px(point) {
    const { x, y, sx, sy } = this.camera, [a, b] = this.axes;
    return [this.left + (this.width - this.left) / 2 + (point[a] - x) * sx, (this.height - this.foot) / 2 - (point[b] - y) * sy];
  }

  get foot() { return 20; }

  zoom(factor, x, y) {
    const c = this.camera, middle = [this.left + (this.width - this.left) / 2, (this.height - this.foot) / 2];
    c.x += ((x - middle[0]) / c.sx) * (1 - 1 / factor);
    c.y -= ((y - middle[1]) / c.sy) * (1 - 1 / factor);
    c.sx *= factor;
    c.sy *= factor;
    this.moved = true;
    redraw();
  }

  draw() {
    const { pen, width, height } = prepared(this.canvas);
    if (!width || !height) return;
    Object.assign(this, { pen, width, height, hits: [] });
    if (!this.moved || !this.camera) this.fit();
    this.makeRoom();
    if (!this.moved) this.fit();
    this.grid();
    pen.save();
    pen.beginPath();
    pen.rect(this.left, 0, width - this.left, height - this.foot);
    pen.clip();
    this.options.paint(this, pen);
    pen.restore();
  }

  /** Room on the left for the numbers of the vertical axis: far from the origin they are long. */
  makeRoom() {
    const { y, sy } = this.camera, h = (this.height - this.foot) / 2 / sy;
    this.pen.font = TICKS;
    const widths = ticks(y - h, y + h, (this.height - this.foot) / 72).map(([, text]) => this.pen.measureText(text).width);
    this.left = Math.max(LEFT, Math.ceil(Math.max(0, ...widths)) + 10);
  }

  grid() {
    const { pen, width, height, left, foot } = this, { x, y, sx, sy } = this.camera;
    const [w, h] = [(width - left) / 2 / sx, (height - foot) / 2 / sy], bottom = height - foot;
    pen.font = TICKS;
    pen.lineWidth = 1;
    pen.strokeStyle = paper("grid");
    pen.fillStyle = paper("muted");
    pen.textBaseline = "top";
    pen.textAlign = "center";
    for (const [value, text] of ticks(x - w, x + w, (width - left) / 72)) {
      const at = left + (width - left) / 2 + (value - x) * sx;
      line(pen, at, 0, at, bottom);
      if (at > left + 8 && at < width - 14) pen.fillText(text, at, bottom + 4);
    }
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const [value, text] of ticks(y - h, y + h, bottom / 72)) {
      const at = bottom / 2 - (value - y) * sy;
      line(pen, left, at, width, at);
      if (at > 8 && at < bottom - 4) pen.fillText(text, left - 5, at);
    }
    pen.strokeStyle = paper("line");
    pen.strokeRect(left + 0.5, 0.5, width - left - 1, bottom - 1);
    label(pen, this.names[0], width - 7, bottom - 10, paper("muted"), { weight: 500, align: "right" });
    label(pen, this.names[1], left + 7, 12, paper("muted"), { weight: 500 });
  }

  listen() {
    const { canvas } = this;
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY];
      if (event.pointerType === "mouse") canvas.setPointerCapture(event.pointerId);
      this.point(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (from && event.pointerType === "mouse" && this.camera) {
        this.camera.x -= (event.clientX - from[0]) / this.camera.sx;
        this.camera.y += (event.clientY - from[1]) / this.camera.sy;
        this.moved ||= Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 0;
        from = [event.clientX, event.clientY];
        redraw();
      } else this.point(event);
    });
    canvas.addEventListener("pointerup", () => { from = null; });
    canvas.addEventListener("pointercancel", () => { from = null; });
    canvas.addEventListener("pointerleave", () => { if (!from) leave(); });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const box = canvas.getBoundingClientRect();
      this.zoom(Math.exp(-event.deltaY / 300), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
  }

  /** Say what is under the pointer. */
  point(event) {
    const box = this.canvas.getBoundingClientRect(), at = [event.clientX - box.left, event.clientY - box.top];
    const near = this.hits
      .map((hit) => [distance(at, hit.from, hit.to), hit])
      .filter(([d, hit]) => d < (hit.reach ?? 9))
      .sort(([d, one], [e, other]) => (other.first ?? 0) - (one.first ?? 0) || d - e)[0];
    if (!near) return leave();
    tell(event, near[1].lines);
    state.facet = near[1].facet ?? null;
    redraw();
  }
}

function line(pen, x1, y1, x2, y2) {
  pen.beginPath();
  pen.moveTo(x1, y1);
  pen.lineTo(x2, y2);
  pen.stroke();
}

/** From a point to a segment. */
function distance([x, y], [x1, y1], [x2, y2]) {
  const [dx, dy] = [x2 - x1, y2 - y1], square = dx * dx + dy * dy;
  const share = square ? Math.min(1, Math.max(0, ((x - x1) * dx + (y - y1) * dy) / square)) : 0;
  return Math.hypot(x - x1 - share * dx, y - y1 - share * dy);
}

/** Show lines of text at the pointer; the first one is bold. */
function tell(event, [first, ...others]) {
  const tip = byId("tip");
  tip.replaceChildren(element("b", {}, first), ...others.flatMap((text) => [element("br"), text]));
  tip.hidden = false;
  const [width, height] = [tip.offsetWidth, tip.offsetHeight];
  tip.style.left = `${Math.max(4, Math.min(event.clientX + 14, window.innerWidth - width - 6))}px`;
  tip.style.top = `${event.clientY + 18 + height > window.innerHeight ? event.clientY - height - 12 : event.clientY + 18}px`;
}

function leave() {
  byId("tip").hidden = true;
  if (state.facet) {
    state.facet = null;
    redraw();
  }
}
