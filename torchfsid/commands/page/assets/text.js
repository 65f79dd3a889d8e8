// Numbers and elements as text.

/** With a minus sign instead of a hyphen. */
const signed = (text) => text.replace(/^-/, "−");

/** A number with a few significant digits; tiny and huge ones as powers of ten. */
function plain(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e-3 && size < 1e5) return signed(String(Number(value.toPrecision(digits))));
  const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
  return `${signed(String(Number(mantissa)))}·10${superscript(Number(exponent))}`;
}

function superscript(exponent) {
  return [...String(exponent)].map((sign) => ({ "-": "⁻" })[sign] ?? "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(sign)]).join("");
}

/** A number with its unit; metres as mm, µm or nm where that reads better. */
function quantity(value, unit, digits = 3) {
  if (value === null || value === undefined) return "–";
  if (unit !== "m") return `${plain(value, digits)}${unit ? ` ${unit}` : ""}`;
  if (value === 0) return "0 m";
  const [scale, name] = [[1, "m"], [1e-3, "mm"], [1e-6, "µm"], [1e-9, "nm"]].find(([s]) => Math.abs(value) >= 0.1 * s) ?? [1e-9, "nm"];
  return `${plain(value / scale, digits)} ${name}`;
}

/** A point with enough digits to tell it apart within `size`. */
function point(values, size, unit) {
  if (!values || values.includes(null)) return "–";
  const digits = size > 0 ? Math.min(9, Math.max(0, Math.ceil(1 - Math.log10(size)))) : 3;
  return `(${values.map((v) => signed(v.toFixed(digits))).join(", ")})${unit ? ` ${unit}` : ""}`;
}

/** A time of the log. */
function seconds(t) {
  return t === null || t === undefined ? "–" : `${Number(t.toFixed(4))} s`;
}

/** An element with text or children; properties that start with "on" are listeners. */
function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

const byId = (id) => document.getElementById(id);
