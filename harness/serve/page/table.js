"use strict";
// Tables over columns: filters, sorting, groups, and a view that holds only the rows that are visible.

const isNumeric = (column) => column.values.some(isNumber);

/** Orders two values: numbers by size, texts by the alphabet, missing values last. */
function order(a, b) {
  if (a === null || b === null) return (a === null) - (b === null);
  if (isNumber(a) && isNumber(b)) return a - b;
  return String(a) < String(b) ? -1 : Number(String(a) > String(b));
}

const COMPARISONS = {
  "=": (a, b) => a === b, "!=": (a, b) => a !== b,
  ">": (a, b) => a > b, "<": (a, b) => a < b, ">=": (a, b) => a >= b, "<=": (a, b) => a <= b,
};

/**
 * Parses a filter. Its terms are separated by spaces, and all of them must match. A term is a part of a name, or a
 * comparison of a column: `latent=64`, `status!=failed`, `"contact_force r2">0.5`. A part of a name with such a sign or a
 * space is quoted. Returns a function of a row's number. Calls `note` with what is wrong. A wrong term matches every row.
 */
function parseFilter(text, columns, note) {
  const terms = text.match(/(?:"[^"]*"|[^\s"])+/g) ?? [];
  note("");
  const tests = terms.map((term) => {
    const parts = /^("[^"]*"|[^\s"=!<>]+)(!=|>=|<=|=|<|>)(.*)$/.exec(term);
    if (!parts) {
      const wanted = term.replaceAll('"', "").toLowerCase();
      const texts = columns.filter((column) => ["experiment", "run", "variant"].includes(column.name));
      return (row) => texts.some((column) => String(column.values[row] ?? "").toLowerCase().includes(wanted));
    }
    const [name, sign, wanted] = [parts[1].replaceAll('"', ""), parts[2], parts[3].replaceAll('"', "")];
    const column = columns.find((column) => column.name.toLowerCase() === name.toLowerCase());
    if (!column) {
      note(`there is no column ${name}`);
      return () => true;
    }
    const compare = COMPARISONS[sign];
    const asNumber = Number(wanted);
    if (isNumeric(column) && wanted !== "" && !Number.isNaN(asNumber)) {
      return (row) => isNumber(column.values[row]) && compare(column.values[row], asNumber);
    }
    return (row) => compare(String(column.values[row] ?? ""), wanted);
  });
  return (row) => tests.every((test) => test(row));
}

/** The mean and the standard deviation of numbers, which is null if there is only one. */
function meanOf(numbers) {
  const mean = numbers.reduce((sum, value) => sum + value, 0) / numbers.length;
  const squares = numbers.reduce((sum, value) => sum + (value - mean) ** 2, 0);
  return { mean, deviation: numbers.length > 1 ? Math.sqrt(squares / (numbers.length - 1)) : null };
}

/** A mean with its standard deviation in words. */
const meanText = ({ mean, deviation }) => (deviation === null ? shown(mean) : `${shown(mean)} ± ${shown(Number(deviation.toPrecision(2)))}`);

/** Whether higher values of a metric are better, in words; `undefined` if that is unknown, as for a user's metric. */
const betterWords = (better) => ({ true: "higher is better", false: "lower is better" })[better];

/** An arrow that says whether higher values of a metric are better; nothing if that is unknown. */
const betterArrow = (better) => ({ true: " ↑", false: " ↓" })[better] ?? "";

/** The height of a row in pixels, as in the style sheet. */
const ROW_HEIGHT = 28;

/**
 * A table with any number of rows, of which only the visible ones are in the document.
 *
 * `columns` is a list of names with values. `rows` are the numbers of the rows to show, or `{ group, rows, open }` for the
 * head of a group. Calls `sorted(name)` for a click on a column's name, `toggled(row)` for a click on a row or group.
 */
class BigTable {
  constructor(place, { sorted, toggled, isChosen }) {
    Object.assign(this, { place, sorted, toggled, isChosen });
    this.head = element("thead");
    this.body = element("tbody");
    this.table = element("table", {}, this.head, this.body);
    place.replaceChildren(this.table);
    place.addEventListener("scroll", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(place);
  }

  show(columns, rows, sort) {
    Object.assign(this, { columns, rows });
    const title = (column) => {
      const direction = sort.name !== column.name ? "none" : sort.down ? "descending" : "ascending";
      const arrow = { none: "", descending: " ▼", ascending: " ▲" }[direction];
      const click = () => this.sorted(column.name);
      const button = element("button", { type: "button", click }, `${column.name}${betterArrow(column.better)}${arrow}`);
      const kind = isNumeric(column) ? "number" : "";
      return element("th", { "aria-sort": direction, scope: "col", class: kind, title: betterWords(column.better) }, button);
    };
    this.head.replaceChildren(element("tr", {}, element("th", { scope: "col" }, ""), ...columns.map(title)));
    this.table.setAttribute("aria-rowcount", rows.length);
    this.draw(true);
  }

  draw(force = false) {
    if (!this.rows) return;
    const first = Math.max(0, Math.floor(this.place.scrollTop / ROW_HEIGHT) - 5);
    const last = Math.min(this.rows.length, first + Math.ceil(Math.max(this.place.clientHeight, window.innerHeight) / ROW_HEIGHT) + 10);
    if (!force && first === this.first && last === this.last) return;
    Object.assign(this, { first, last });
    const gap = (rows) => {
      const space = element("tr", { "aria-hidden": "true" });
      space.style.height = `${rows * ROW_HEIGHT}px`;
      return space;
    };
    const visible = this.rows.slice(first, last).map((row) => (isNumber(row) ? this.row(row) : this.groupRow(row)));
    this.body.replaceChildren(gap(first), ...visible, gap(this.rows.length - last));
  }

  row(row) {
    const chosen = this.isChosen(row);
    const box = element("input", { type: "checkbox", "aria-label": "show this run", checked: chosen ? "" : undefined });
    const cells = this.columns.map(({ name, values }) => {
      const value = values[row];
      const kind = name === "status" ? `status-${value}` : isNumber(value) ? "number" : "";
      const text = shown(value);
      // The style sheet cuts long texts off.
      return element("td", { class: kind, title: text.length > 24 ? text : undefined }, text);
    });
    return element("tr", { class: chosen ? "chosen" : "", click: () => this.toggled(row) }, element("td", {}, box), ...cells);
  }

  groupRow(group) {
    const button = element("button", { type: "button", "aria-expanded": String(group.open) }, group.open ? "−" : "+");
    const cells = this.columns.map((column, index) => {
      if (index === 0) return element("td", {}, `${shown(group.group)} (${group.rows.length})`);
      const numbers = group.rows.map((row) => column.values[row]).filter(isNumber);
      if (!column.metric || numbers.length === 0) return element("td");
      const title = `mean ± standard deviation of ${numbers.length} ${numbers.length === 1 ? "run" : "runs"}`;
      return element("td", { class: "number", title }, `mean ${meanText(meanOf(numbers))}`);
    });
    return element("tr", { class: "group", click: () => this.toggled(group) }, element("td", {}, button), ...cells);
  }
}

/** A small table of all rows of an answer. Values may be elements. A column may name its class, `kind`. */
function plainTable(columns, classOf = () => "") {
  const all = columns.map((column) => ({ kind: isNumeric(column) ? "number" : "", ...column }));
  const head = all.map(({ kind, name }) => element("th", { scope: "col", class: kind }, name));
  const cell = (column, row) => {
    const value = column.values[row];
    return element("td", { class: `${column.kind} ${classOf(column, value)}`.trim() }, value instanceof Node ? value : shown(value));
  };
  const rows = (columns[0]?.values ?? []).map((_, row) => element("tr", {}, ...all.map((column) => cell(column, row))));
  return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows));
}
