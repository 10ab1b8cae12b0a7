// Elements, texts and numbers for both pages.

/**
 * Makes an HTML element with attributes, listeners and children. A function listens to the event of its name. `undefined` is left
 * out. Strings become text nodes, so tables can't insert HTML.
 */
function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(key, value);
    else if (value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** A value as text: numbers other than integers have four significant digits, and a missing value is a dash. */
function shown(value) {
  if (value === null || value === undefined || value === "") return "–";
  if (typeof value !== "number") return String(value);
  return String(Number.isInteger(value) ? value : Number(value.toPrecision(4))).replace("-", "\u2212");
}

/** A mean in words, followed by its interval in brackets if there is one. */
function interval(mean, low, high) {
  return low === null || low === undefined ? shown(mean) : `${shown(mean)} [${shown(low)}, ${shown(high)}]`;
}

const isNumber = (value) => typeof value === "number";

/** The distinct values. Numbers are sorted, and other values keep their order. */
function distinct(values) {
  const all = [...new Set(values)];
  return all.every(isNumber) ? all.sort((a, b) => a - b) : all;
}

/** The smallest and the largest number. */
function extent(numbers) {
  return [numbers.reduce((a, b) => Math.min(a, b), Infinity), numbers.reduce((a, b) => Math.max(a, b), -Infinity)];
}
