// Tables that can be sorted by any column and searched.

const FIRST = 500; // lines of a table that are shown before one asks for all
const data = JSON.parse(byId("data").textContent);

byId("title").textContent = data.title;
byId("lead").textContent = data.lead;
byId("tables").append(...data.tables.map(sortable));

const words = (cell) => (Array.isArray(cell) ? cell[0] : cell);

/** Numbers before texts, texts with their numbers in order, nothing last. */
function compare(one, other) {
  const [a, b] = [words(one), words(other)];
  if (a === null || b === null) return (a === null) - (b === null);
  if (typeof a === "number" && typeof b === "number") return a - b;
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
  return String(a).localeCompare(String(b), undefined, { numeric: true });
}

function cell(value, numeric) {
  const inside = Array.isArray(value) ? element("a", { href: value[1] }, value[0]) : value === null ? "" : typeof value === "number" ? plain(value, 6) : value;
  return element("td", { className: numeric ? "number" : "", title: typeof value === "string" ? value : "" }, inside);
}

function sortable({ title, columns, rows }) {
  const numeric = columns.map((_, k) => rows.some((row) => typeof row[k] === "number") && rows.every((row) => row[k] === null || typeof row[k] === "number"));
  const order = { column: null, down: false, all: false };
  const count = element("span", { className: "muted small" });
  const search = element("input", { type: "search", placeholder: "search", "aria-label": `Search ${title}`, oninput: () => fill() });
  const more = element("button", { onclick: () => { order.all = true; fill(); } }, "show all");
  const body = element("tbody");
  const heads = columns.map((name, k) => element("th", { className: numeric[k] ? "number" : "" }, element("button", { onclick: () => sort(k) }, name)));

  function sort(k) {
    order.down = order.column === k && !order.down;
    order.column = k;
    heads.forEach((head, j) => {
      if (j === k) head.setAttribute("aria-sort", order.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
    fill();
  }

  function fill() {
    const wanted = search.value.toLowerCase();
    let found = rows.filter((row) => !wanted || row.some((value) => String(words(value) ?? "").toLowerCase().includes(wanted)));
    const k = order.column;
    if (k !== null) {
      found = [...found].sort((one, other) => {
        const empty = (words(one[k]) === null) - (words(other[k]) === null);
        return empty || (order.down ? -1 : 1) * compare(one[k], other[k]);
      });
    }
    const shown = order.all ? found : found.slice(0, FIRST);
    body.replaceChildren(...shown.map((row) => element("tr", {}, ...row.map((value, j) => cell(value, numeric[j])))));
    count.textContent = shown.length < rows.length ? `${shown.length} of ${rows.length} lines` : `${rows.length} lines`;
    more.hidden = shown.length === found.length;
  }

  fill();
  return element("section", { className: "panel" },
    element("h2", {}, title), element("div", { className: "tools" }, search, count, more),
    element("div", { className: "scroll", tabIndex: 0 }, element("table", {}, element("thead", {}, element("tr", {}, ...heads)), body)));
}
