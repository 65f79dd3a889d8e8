// Charts over time (or distance): axes, ticks, and a still picture under what moves.

/** Ticks of a logarithmic axis: powers of ten, and 2 and 5 where there are few. */
function logTicks(low, high) {
  const values = [];
  const [first, end] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
  const step = Math.ceil((end - first) / 7), multiples = end - first <= 2 ? [1, 2, 5] : [1];
  for (let power = first; power <= end; power += step) {
    for (const m of multiples) if (m * 10 ** power >= low * 0.999 && m * 10 ** power <= high * 1.001) values.push(m * 10 ** power);
  }
  return values;
}

class Chart {
  /**
   * @param canvas where it is drawn
   * @param options left, foot: room for labels; range(): [low, high] of the x axis; paint(chart, pen): the still
   *   picture, drawn again when key() changes; above(chart, pen): what moves; lines(x, y): words for the pointer;
   *   pick(x): the pointer chose this x
   */
  constructor(canvas, options) {
    Object.assign(this, { canvas, options, top: 8, right: 14 });
    this.still = document.createElement("canvas");
    let held = false;
    const at = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
      held = Boolean(options.pick);
      if (held) {
        canvas.setPointerCapture(event.pointerId);
        options.pick(this.value(at(event)[0]));
      }
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = at(event);
      if (held) options.pick(this.value(x));
      const lines = options.lines?.(x, y);
      if (lines) tell(event, lines);
      else leave();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { held = false; });
    canvas.addEventListener("pointerleave", leave);
    listeners.push(() => this.draw());
  }

  get left() { return this.options.left(); }
  get foot() { return this.options.foot ?? 34; }

  /** From a value on the x axis to the canvas, and back. */
  px(value) {
    const [low, high] = this.options.range();
    return this.left + ((value - low) / (high - low || 1)) * (this.width - this.left - this.right);
  }

  value(x) {
    const [low, high] = this.options.range();
    return low + ((x - this.left) / Math.max(1, this.width - this.left - this.right)) * (high - low);
  }

  draw() {
    const { pen, width, height } = prepared(this.canvas);
    if (!width || !height) return;
    Object.assign(this, { width, height });
    const key = [this.canvas.width, this.canvas.height, dark.matches, this.options.key()].join("|");
    if (key !== this.drawn) {
      this.drawn = key;
      Object.assign(this.still, { width: this.canvas.width, height: this.canvas.height });
      const under = this.still.getContext("2d");
      under.setTransform(pen.getTransform());
      this.options.paint(this, under);
    }
    pen.drawImage(this.still, 0, 0, width, height);
    this.options.above?.(this, pen);
  }

  /** Grid lines and labels of the x axis. */
  xAxis(pen, name) {
    const bottom = this.height - this.foot;
    pen.font = `11px ${FONT}`;
    pen.textAlign = "center";
    pen.textBaseline = "top";
    pen.lineWidth = 1;
    for (const [value, text] of ticks(...this.options.range(), (this.width - this.left) / 75)) {
      const x = this.px(value);
      pen.strokeStyle = paper("grid");
      line(pen, x, this.top, x, bottom);
      pen.fillStyle = paper("muted");
      pen.fillText(text, x, bottom + 4);
    }
    pen.textAlign = "right";
    pen.textBaseline = "alphabetic";
    pen.fillText(name, this.width - this.right, this.height - 3);
    pen.strokeStyle = paper("line");
    line(pen, this.left, bottom, this.width - this.right, bottom);
  }

  /** A grid line with its label at the left. */
  yTick(pen, y, text) {
    pen.font = `11px ${FONT}`;
    pen.strokeStyle = paper("grid");
    pen.lineWidth = 1;
    line(pen, this.left, y, this.width - this.right, y);
    pen.fillStyle = paper("muted");
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.fillText(text, this.left - 6, y);
  }
}
