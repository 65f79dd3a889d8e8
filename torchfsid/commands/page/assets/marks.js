// The marks of the map: outlines, hatching, crosses, labels.

function trace(pen, points, closed = true) {
  pen.beginPath();
  points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  if (closed) pen.closePath();
}

/** Fill an outline with thin diagonal lines. */
function hatch(pen, points, ink) {
  pen.save();
  trace(pen, points);
  pen.clip();
  const xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
  const [left, right, top, bottom] = [Math.max(0, Math.min(...xs)), Math.max(...xs), Math.max(0, Math.min(...ys)), Math.max(...ys)];
  const [wide, tall] = [Math.min(right, 4000) - left, Math.min(bottom, 4000) - top];
  pen.strokeStyle = ink;
  pen.lineWidth = 1;
  pen.setLineDash([]);
  pen.beginPath();
  for (let x = left - tall; x < left + wide; x += 7) {
    pen.moveTo(x, top + tall);
    pen.lineTo(x + tall, top);
  }
  pen.stroke();
  pen.restore();
}

const shapes = {
  centroid(pen, x, y, r) { line(pen, x - r, y, x + r, y); line(pen, x, y - r, x, y + r); },
  ukf(pen, x, y, r) { trace(pen, [[x, y - r], [x + r, y], [x, y + r], [x - r, y]]); pen.stroke(); },
  hybrid(pen, x, y, r) { pen.strokeRect(x - 0.8 * r, y - 0.8 * r, 1.6 * r, 1.6 * r); },
  truth(pen, x, y, r) {
    const tips = Array.from({ length: 10 }, (_, k) => {
      const [angle, reach] = [(k * Math.PI) / 5 - Math.PI / 2, k % 2 ? 0.45 * r : 1.15 * r];
      return [x + reach * Math.cos(angle), y + reach * Math.sin(angle)];
    });
    trace(pen, tips);
    pen.fill();
    pen.stroke();
  },
};

/** A mark of an estimate, with a halo of the paper so that it is seen on every ground. */
function mark(pen, shape, [x, y], ink, r = 6) {
  pen.setLineDash([]);
  for (const [stroke, width] of [[paper("panel"), 4.5], [ink, 1.9]]) {
    pen.strokeStyle = stroke;
    pen.fillStyle = ink;
    pen.lineWidth = width;
    shapes[shape](pen, x, y, r);
  }
}

/** A text with a halo of the paper. */
function label(pen, text, x, y, ink, { size = 11.5, weight = 600, align = "left" } = {}) {
  pen.font = `${weight} ${size}px ${FONT}`;
  pen.textAlign = align;
  pen.textBaseline = "middle";
  pen.lineJoin = "round";
  pen.setLineDash([]);
  pen.strokeStyle = paper("panel");
  pen.lineWidth = 3.5;
  pen.strokeText(text, x, y);
  pen.fillStyle = ink;
  pen.fillText(text, x, y);
}

function disc(pen, [x, y], r, fill, stroke) {
  pen.beginPath();
  pen.arc(x, y, r, 0, 2 * Math.PI);
  if (fill) { pen.fillStyle = fill; pen.fill(); }
  if (stroke) { pen.strokeStyle = stroke; pen.stroke(); }
}

/** An arrow between two points of the canvas. */
function arrow(pen, [x1, y1], [x2, y2]) {
  const angle = Math.atan2(y2 - y1, x2 - x1), length = Math.hypot(x2 - x1, y2 - y1);
  if (length < 3) return;
  line(pen, x1, y1, x2, y2);
  const tip = Math.min(7, length);
  trace(pen, [-0.42, 0.42].flatMap((turn, k) => {
    const end = [x2 - tip * Math.cos(angle + turn), y2 - tip * Math.sin(angle + turn)];
    return k ? [end] : [end, [x2, y2]];
  }), false);
  pen.stroke();
}

const short = (name) => (name.length > 18 ? `${name.slice(0, 17)}…` : name);
