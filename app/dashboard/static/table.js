// A table that sorts, filters, shows more on demand and saves itself as CSV.
import { h } from "./magcal.js";

const PAGE = 50;
// So many rows are seen at a glance: nobody needs to filter them.
export const AT_A_GLANCE = 9;

// Saves rows as a CSV file. A cell that a spreadsheet would run as a formula gets a quote in front, as the API's tables have it.
export function saveCsv(columns, rows, file) {
  const harmless = (value) => (/^[=+\-@\t\r]/.test(value) && !/^[+-]?(\d[\d,]*\.?\d*|\.\d+)([eE][+-]?\d+)?$/.test(value) ? `'${value}` : value);
  const cell = (value) => ((found) => (/[",\r\n\t]/.test(found) ? `"${found.replaceAll('"', '""')}"` : found))(harmless(String(value ?? "")));
  const lines = [columns.map((column) => cell(column.name)), ...rows.map((row) => columns.map((column) => cell(column.value(row))))];
  const blob = new Blob([lines.map((line) => line.join(",")).join("\r\n") + "\r\n"], { type: "text/csv" });
  const link = h("a", { href: URL.createObjectURL(blob), download: `${file}.csv` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// columns: [{ name, value: row => number|string, show?: row => text or node, numeric?: bool, heads?: bool, strong?: bool }]
// The table's own `renew(rows)` shows other rows, sorted and filtered as before.
export function table(columns, rows, { caption, file = "table", empty = "Nothing here yet.", sort = null, note = null, look = () => "" } = {}) {
  if (!rows.length) return h("p", { class: "muted" }, empty);
  const order = { column: sort?.column ?? null, up: sort?.up ?? false };
  let wanted = "";
  let most = PAGE;

  const text = (column, row) => {
    const value = column.value(row);
    return value === null || value === undefined ? "" : String(value);
  };
  const head = columns.map((column, i) => h("th", { scope: "col", class: column.numeric ? "n" : "" },
    h("button", { type: "button", class: "sort", onclick: () => sortBy(i) }, column.name)));
  const body = h("tbody");
  const count = h("span", { class: "muted" });
  const more = h("button", { type: "button", onclick: () => { most += 4 * PAGE; draw(); } });
  const filter = h("input", { type: "search", placeholder: "Filter", "aria-label": `Filter ${caption}`,
    oninput: (event) => { wanted = event.target.value.toLowerCase(); most = PAGE; draw(); } });

  function found() {
    const kept = rows.filter((row) => !wanted || columns.some((column) => text(column, row).toLowerCase().includes(wanted)));
    if (order.column === null) return kept;
    const { value } = columns[order.column];
    const rank = (row) => value(row) ?? "";
    return kept.sort((a, b) => {
      const [x, y] = [rank(a), rank(b)];
      const sign = typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y));
      return order.up ? sign : -sign;
    });
  }

  function sortBy(i) {
    order.up = order.column === i ? !order.up : !columns[i].numeric;
    order.column = i;
    draw();
  }

  function draw() {
    const all = found();
    head.forEach((cell, i) => {
      if (order.column === i) cell.setAttribute("aria-sort", order.up ? "ascending" : "descending");
      else cell.removeAttribute("aria-sort");
    });
    body.replaceChildren(...all.slice(0, most).map((row) => h("tr", { class: look(row) || null }, columns.map((column) =>
      h(column.heads ? "th" : "td", { scope: column.heads ? "row" : null, class: `${column.numeric ? "n" : ""}${column.strong ? " strong" : ""}` },
        (column.show ?? ((r) => text(column, r)))(row) ?? "–")))));
    filter.hidden = rows.length <= AT_A_GLANCE && !wanted && document.activeElement !== filter;
    count.textContent = wanted ? `${all.length} of ${rows.length} rows` : `${rows.length} ${rows.length === 1 ? "row" : "rows"}`;
    more.hidden = all.length <= most;
    more.textContent = `Show more (${all.length - most} hidden)`;
  }

  draw();
  const node = h("div", { class: "table" },
    h("div", { class: "tools" }, filter, count, h("button", { type: "button", class: "quiet", onclick: () => saveCsv(columns, found(), file), "aria-label": `Save ${caption} as CSV` }, "CSV")),
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
      h("table", {}, note ? h("caption", {}, note) : null, h("thead", {}, h("tr", {}, head)), body)), more);
  node.renew = (others) => { rows = others; draw(); };
  return node;
}
