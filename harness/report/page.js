"use strict";
// Plays the clips and draws the interactive charts. The numbers come from the page's JSON element `data`.
{
const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";

/** Makes an HTML element with attributes and children. Strings become text nodes, so tables can't insert HTML. */
function element(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** Makes an SVG element with attributes and children. */
function shape(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(made, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** A number rounded to four significant digits. */
function rounded(value) {
  return String(Number(value.toPrecision(4))).replace("-", "\u2212");
}

/** A mean in words, followed by its interval in brackets if there is one. */
function interval([mean, low, high]) {
  return low === undefined ? rounded(mean) : `${rounded(mean)} [${rounded(low)}, ${rounded(high)}]`;
}

/** The distinct values. Numbers are sorted, and other values keep their order. */
function distinct(values) {
  const all = [...new Set(values)];
  return all.every((value) => typeof value === "number") ? all.sort((a, b) => a - b) : all;
}

// --- Clips ---

/** Plays a clip's pictures in a loop, at the speed of the simulation. */
class Clip {
  constructor(figure, clip) {
    this.clip = clip;
    this.picture = figure.querySelector("img");
    this.button = figure.querySelector("button");
    this.slider = figure.querySelector("input");
    this.output = figure.querySelector("output");
    this.slider.max = clip.frames.length - 1;
    this.slider.addEventListener("input", () => this.show(Number(this.slider.value)));
    this.button.addEventListener("click", () => (this.timer ? this.pause() : this.play()));
    figure.querySelector(".controls").hidden = false;
    this.show(0);
  }

  show(frame) {
    this.picture.src = `data:image/jpeg;base64,${this.clip.frames[frame]}`;
    this.slider.value = frame;
    const time = `${(frame * this.clip.seconds).toFixed(1)} s`;
    this.output.textContent = time;
    this.slider.setAttribute("aria-valuetext", time);
  }

  play() {
    const next = () => this.show((Number(this.slider.value) + 1) % this.clip.frames.length);
    this.timer = setInterval(next, 1000 * this.clip.seconds);
    this.button.textContent = "Pause";
  }

  pause() {
    clearInterval(this.timer);
    this.timer = undefined;
    this.button.textContent = "Play";
  }
}

// --- Choices ---

/**
 * Select elements for the fields of rows. Each select offers the values of the rows that match the selects before it. It
 * keeps the chosen value as long as it is offered.
 *
 * A field has a `key` of the rows and a `label`. These are optional: `words` (returns a value's name), `first` (the value
 * chosen at first), `values` (the values to choose from, if `key` isn't a key of the rows), and `unless` (returns whether
 * the field is hidden, given the values chosen before).
 */
class Choices {
  constructor(place, rows, fields, changed) {
    this.rows = rows;
    this.changed = changed;
    this.fields = fields.map((field) => {
      const select = element("select");
      return { ...field, select, place: element("label", {}, field.label, select) };
    });
    place.append(element("div", { class: "choices" }, ...this.fields.map((field) => field.place)));
    for (const field of this.fields) {
      field.select.addEventListener("change", () => {
        field.chosen = field.offered[field.select.selectedIndex];
        this.update();
      });
    }
    this.update();
  }

  update() {
    let left = this.rows;
    const chosen = {};
    for (const field of this.fields) {
      field.place.hidden = field.unless?.(chosen) ?? false;
      if (field.place.hidden) continue;
      field.offered = field.values ?? distinct(left.map((row) => row[field.key]).filter((value) => value !== null));
      const wanted = [field.chosen, field.first].find((value) => field.offered.includes(value)) ?? field.offered[0];
      const words = field.words ?? String;
      const option = (value) => new Option(words(value), value, false, value === wanted);
      field.select.replaceChildren(...field.offered.map(option));
      chosen[field.key] = wanted;
      // A row without a value matches every choice. For example, a baseline matches every latent size.
      if (!field.values) left = left.filter((row) => row[field.key] === null || row[field.key] === wanted);
    }
    this.changed(chosen, left);
  }
}

// --- Charts ---

const MARGIN = { left: 58, right: 14, top: 10, bottom: 46 };

/** Round values from low to high, about `count` of them. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= rough * 0.999);
  const first = Math.ceil(low / step - 1e-6);
  const last = Math.floor(high / step + 1e-6);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

/** Powers of ten from low to high. A short axis also has their multiples, and a very short one has round values. */
function logarithmicTicks(low, high) {
  if (high / low < 8) return ticks(low, high, 4);
  const all = [];
  const few = Math.log10(high / low) < 2.5;
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) {
    for (const factor of few ? [1, 2, 5] : [1]) all.push(factor * 10 ** power);
  }
  return all.filter((tick) => tick >= low * 0.999 && tick <= high * 1.001);
}

function mark(kind, hollow, [x, y]) {
  const look = { class: hollow ? "mark hollow" : "mark" };
  if (kind === "square") return shape("rect", { ...look, x: x - 3.2, y: y - 3.2, width: 6.4, height: 6.4 });
  if (kind === "beyond") return shape("path", { ...look, d: `M${x - 4} ${y - 3}h8l-4 6z` });
  return shape("circle", { ...look, cx: x, cy: y, r: kind === "dot" ? 2.6 : 3.6 });
}

/**
 * A chart that is as wide as its place. The pointer, a touch or the arrow keys show the values of a point.
 *
 * The content has axes `x` and `y` (`label`, `low`, `high`, and `ticks` or `logarithmic`) and `series`. A series has a
 * `name`, an optional shorter `entry` for the legend, a `look` (classes of the style sheet), `line` (whether it has a
 * line), `kind` (the shape of its marks), `behind` (whether it lies behind other series), and `points`. A point has `x`,
 * `y`, `bounds` (the ends of its interval) and `says` (the lines of its tooltip). A series without a name has no tooltips.
 * A `small` chart has no legend of its own.
 */
class Chart {
  constructor(place, name) {
    this.name = name;
    this.legend = element("ul", { class: "legend" });
    this.tooltip = element("div", { class: "tooltip", role: "status", hidden: "" });
    this.plot = element("div", { class: "plot" }, this.tooltip);
    place.append(this.legend, this.plot);
    new ResizeObserver(() => this.content && this.plot.clientWidth !== this.width && this.draw()).observe(this.plot);
  }

  show(content) {
    this.content = content;
    this.draw();
    this.legend.replaceChildren(...(content.small ? [] : legendEntries(content.series)));
  }

  draw() {
    const { x, y, series, square, small } = this.content;
    this.width = this.plot.clientWidth;
    const oblong = small ? Math.max(200, this.width * 0.62) : Math.max(260, Math.min(420, this.width * 0.5));
    const height = square ? Math.min(this.width, 520) : oblong;
    const width = square ? Math.min(this.width, 560) : this.width;
    const right = width - MARGIN.right;
    const bottom = height - MARGIN.bottom;
    const place = (axis, from, to) => {
      const of = axis.logarithmic ? Math.log : (value) => value;
      const part = (value) => (of(value) - of(axis.low)) / (of(axis.high) - of(axis.low));
      return (value) => from + part(Math.min(Math.max(value, axis.low), axis.high)) * (to - from);
    };
    const [across, up] = [place(x, MARGIN.left, right), place(y, bottom, MARGIN.top)];

    const svg = shape("svg", {
      viewBox: `0 0 ${width} ${height}`, width, height, tabindex: 0, role: "group",
      "aria-label": `${this.name}: ${y.label} over ${x.label}. Arrow keys go from point to point.`,
    });
    svg.style.maxWidth = `${width}px`;
    for (const tick of y.logarithmic ? logarithmicTicks(y.low, y.high) : ticks(y.low, y.high, 5)) {
      svg.append(shape("path", { class: "grid", d: `M${MARGIN.left} ${up(tick)}H${right}` }));
      svg.append(shape("text", { x: MARGIN.left - 7, y: up(tick) + 4, "text-anchor": "end" }, rounded(tick)));
    }
    const steps = x.ticks ?? ticks(x.low, x.high, width < 480 ? 4 : 8).map((at) => ({ at, text: rounded(at) }));
    for (const { at, text } of steps) {
      svg.append(shape("text", { x: across(at), y: bottom + 18, "text-anchor": "middle" }, text));
    }
    const middle = (MARGIN.left + right) / 2;
    svg.append(shape("text", { class: "label", x: middle, y: height - 8, "text-anchor": "middle" }, x.label));
    const turn = `translate(13 ${(MARGIN.top + bottom) / 2}) rotate(-90)`;
    svg.append(shape("text", { class: "label", transform: turn, "text-anchor": "middle" }, y.label));
    svg.append(shape("path", { class: "axis", d: `M${MARGIN.left} ${bottom}H${right}` }));
    if (square) {
      svg.append(shape("path", { class: "diagonal", d: `M${across(x.low)} ${up(x.low)}L${across(x.high)} ${up(x.high)}` }));
    }
    const drawn = series.map((one) => this.drawSeries(one, across, up, y));
    svg.append(...drawn.filter((_, index) => series[index].behind).map(({ group }) => group));
    svg.append(...drawn.filter((_, index) => !series[index].behind).map(({ group }) => group));
    this.points = drawn.map(({ points }) => points);
    this.cursor = shape("circle", { class: "cursor", r: 7, visibility: "hidden" });
    svg.append(this.cursor);
    this.listen(svg);
    this.plot.replaceChildren(svg, this.tooltip);
    this.hide();
  }

  /** Draws a series. Returns its SVG group, and its points with their places if the series has a name. */
  drawSeries(series, across, up, y) {
    const group = shape("g", { class: `series ${series.look}` });
    const points = series.points.filter((point) => point.y !== null && point.y !== undefined);
    const places = points.map((point) => [across(point.x), up(point.y)]);
    if (series.line) {
      const path = places.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`).join("L");
      if (path) group.append(shape("path", { class: `line ${series.dash ?? ""}`, d: `M${path}` }));
    }
    points.forEach((point, index) => {
      if (point.bounds) {
        const [low, high] = point.bounds.map(up);
        group.append(shape("path", { class: "bar", d: `M${places[index][0]} ${low}V${high}` }));
      }
      const beyond = point.y < y.low || point.y > y.high;
      if (series.kind) group.append(mark(beyond ? "beyond" : series.kind, series.hollow, places[index]));
    });
    return { group, points: series.name ? points.map((point, index) => ({ ...point, place: places[index] })) : [] };
  }

  listen(svg) {
    const nearest = (event) => {
      const box = svg.getBoundingClientRect();
      const [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let best = { distance: 40 };
      this.points.forEach((points, series) => points.forEach(({ place }, point) => {
        // If marks overlap, the one in front is chosen.
        const distance = Math.hypot(place[0] - x, place[1] - y) + (this.content.series[series].behind ? 6 : 0);
        if (distance < best.distance) best = { distance, series, point };
      }));
      if (best.series === undefined) this.hide();
      else this.point(best.series, best.point);
    };
    svg.addEventListener("pointermove", nearest);
    svg.addEventListener("pointerdown", nearest);
    svg.addEventListener("pointerleave", () => this.hide());
    svg.addEventListener("blur", () => this.hide());
    svg.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.key === "Escape") return this.hide();
    const sides = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] };
    const move = sides[event.key];
    const full = this.points.map((points, index) => index).filter((index) => this.points[index].length > 0);
    if (!move || full.length === 0) return undefined;
    event.preventDefault();
    const first = full.find((index) => !this.content.series[index].behind) ?? full[0];
    const { series, point } = this.at ?? { series: first, point: -move[1] };
    const next = full[(full.indexOf(series) + move[0] + full.length) % full.length];
    const last = this.points[next].length - 1;
    return this.point(next, Math.min(Math.max(point + move[1], 0), last));
  }

  point(series, point) {
    this.at = { series, point };
    const { place: [x, y], says } = this.points[series][point];
    fill(this.cursor, { cx: x, cy: y, visibility: "visible" }, []);
    const name = element("b", {}, this.content.series[series].name);
    this.tooltip.replaceChildren(name, ...says.map((line) => element("span", {}, line)));
    this.tooltip.hidden = false;
    const [width, height] = [this.tooltip.offsetWidth, this.tooltip.offsetHeight];
    const left = x + 14 + width > this.width ? x - 14 - width : x + 14;
    this.tooltip.style.left = `${Math.max(0, Math.min(left, this.width - width))}px`;
    this.tooltip.style.top = `${Math.max(0, y - height - 10)}px`;
  }

  hide() {
    this.at = undefined;
    this.tooltip.hidden = true;
    this.cursor.setAttribute("visibility", "hidden");
  }
}

/** The entries of the legend, one for each different entry of the series with a name. */
function legendEntries(all) {
  const named = all.filter((series) => series.name);
  const entry = (series) => series.entry ?? series.name;
  const unique = named.filter((series, index) => named.findIndex((other) => entry(other) === entry(series)) === index);
  const entries = [...unique.filter((series) => !series.behind), ...unique.filter((series) => series.behind)];
  return entries.map((series) => element("li", {}, swatch(series), entry(series)));
}

/** A sample of a series' line and mark for the legend. */
function swatch(series) {
  const group = shape("g", { class: `series ${series.look}` });
  if (series.line) group.append(shape("path", { class: `line ${series.dash ?? ""}`, d: "M1 7H27" }));
  if (series.kind) group.append(mark(series.kind, series.hollow, [14, 7]));
  return shape("svg", { width: 28, height: 14, "aria-hidden": "true" }, group);
}

// --- Words ---

const DIRECTIONS = { fe: "flexion/extension", aa: "adduction/abduction" };
const directionOf = (joint) => (joint % 2 === 0 ? "fe" : "aa");
const METRICS = { r2: "R\u00b2", rmse: "RMSE", mae: "MAE", smape: "SMAPE", wmape: "WMAPE" };
const MODALITIES = { proprioception: "joint angles", contact_force: "contact forces" };
const spaced = (name) => name.replaceAll("_", " ");
const modalityWords = (name) => MODALITIES[name] ?? spaced(name);
const withUnit = (words, unit) => (unit === "1" ? words : `${words} (${unit})`);
const overWords = (over) => (over === "one seed" ? over : `mean over ${over} [95 % interval]`);
const colorOf = (study) => (study === "single_to_multi" ? "first" : "second");

// --- By joint and link ---

const BOTH = "both";

/** The name and the look of a row's series in one direction. */
function lookOf(row, direction) {
  const lateral = direction === "aa";
  const looks = {
    network: [row.input, colorOf(row.study)],
    // Persistence needs no input of the networks, so it is the same for both studies.
    persistence: ["persistence", "baseline"],
    ridge: [`ridge regression ${row.input}`, colorOf(row.study) === "first" ? "third" : "fourth"],
  };
  const [words, look] = looks[row.model];
  return {
    name: `${words}, ${DIRECTIONS[direction]}`,
    entry: words,
    look,
    dash: row.model !== "network" ? "dotted" : lateral ? "dashed" : "",
    kind: lateral ? "square" : "disc",
    hollow: lateral,
    line: true,
    behind: row.model !== "network",
  };
}

/** The rows without the second study's persistence, because both studies have the same. */
function withoutTwins(rows) {
  const first = rows.find((row) => row.model === "persistence");
  return rows.filter((row) => row.model !== "persistence" || row === first);
}

function valuePoint(x, value, row, says) {
  const unit = row.unit === "1" ? "" : ` ${row.unit}`;
  const line = `${METRICS[row.metric] ?? row.metric} ${interval(value)}${unit}`;
  const over = row.model === "network" ? [overWords(row.over)] : [];
  return { x, y: value[0], bounds: value.length > 1 ? value.slice(1) : undefined, says: [says, line, ...over] };
}

/** The axis of a metric. Its range is chosen for the networks. Baselines beyond it get the mark `beyond`. */
function valueAxis(rows, series) {
  const { metric, unit } = rows[0];
  const label = withUnit(METRICS[metric] ?? metric, unit);
  const networks = series.filter((one) => !one.behind);
  const points = (networks.length ? networks : series).flatMap((one) => one.points);
  // The metric isn't defined for any point. For example, a link that is never touched has no percentage.
  if (points.length === 0) return { label, low: 0, high: 1 };
  const means = points.map((point) => point.y);
  const ends = points.flatMap((point) => point.bounds ?? [point.y]);
  // R2 has no lower bound, but values below -1 need not be told apart.
  if (metric === "r2") return { label, low: Math.max(-1, Math.floor(Math.min(0.9, ...ends) * 10) / 10), high: 1 };
  const most = Math.max(...means);
  const baselines = series.filter((one) => one.behind).flatMap((one) => one.points.map((point) => point.y));
  const reach = Math.min(Math.max(...ends, ...baselines), 1.4 * most);
  return { label, low: 0, high: Math.max(most, reach) * 1.04 || 1 };
}

function jointSeries(rows, directions) {
  return rows.flatMap((row) => directions.map((direction) => {
    const places = row.values.map((value, joint) => ({ value, joint }));
    const some = places.filter(({ value, joint }) => value && directionOf(joint) === direction);
    const part = row.modality === "proprioception" ? "joint" : "link";
    const cell = row.latent === null ? "" : `, latent size ${row.latent}`;
    const says = (joint) => `${part} ${joint}${cell}`;
    const points = some.map(({ value, joint }) => valuePoint(joint, value, row, says(joint)));
    return { ...lookOf(row, direction), points };
  })).filter((series) => series.points.length > 0);
}

/** Series over latent sizes, of all joints or links of a direction together. A baseline is the same at every size. */
function latentSeries(rows, directions, latents) {
  const lines = new Map();
  for (const row of rows) {
    for (const direction of directions) {
      const value = row.overall[direction];
      if (!value) continue;
      const look = lookOf(row, direction);
      const line = lines.get(look.name) ?? { ...look, points: [] };
      const places = row.latent === null ? latents.map((_, place) => place) : [latents.indexOf(row.latent)];
      const says = (place) => (row.latent === null ? "at every latent size" : `latent size ${latents[place]}`);
      line.points.push(...places.map((place) => valuePoint(place, value, row, says(place))));
      if (row.latent === null) line.kind = undefined;
      lines.set(look.name, line);
    }
  }
  return [...lines.values()];
}

/** The smallest of the latent sizes that the most studies have. */
function sharedLatent(rows) {
  const latents = distinct(rows.map((row) => row.latent).filter((latent) => latent !== null));
  const studies = (latent) => distinct(rows.filter((row) => row.latent === latent).map((row) => row.study)).length;
  return latents.reduce((best, latent) => (studies(latent) > studies(best) ? latent : best), latents[0]);
}

function showJoints(place) {
  let chart;
  const over = { joint: "joint or link", latent: "latent size" };
  const fields = [
    { key: "task", label: "Task" },
    { key: "modality", label: "Of", words: modalityWords },
    { key: "metric", label: "Metric", first: "r2", words: (name) => METRICS[name] ?? spaced(name) },
    { key: "scenario", label: "Scenario", first: "cluttered" },
    { key: "direction", label: "Direction", values: [BOTH, "fe", "aa"], words: (name) => DIRECTIONS[name] ?? name },
    { key: "over", label: "Over", values: Object.keys(over), words: (name) => over[name] },
    { key: "latent", label: "Latent size", first: sharedLatent(data.joints), unless: (chosen) => chosen.over === "latent" },
  ];
  new Choices(place, data.joints, fields, (chosen, left) => {
    chart ??= new Chart(place, "Predictions by joint and link");
    const directions = chosen.direction === BOTH ? Object.keys(DIRECTIONS) : [chosen.direction];
    const alike = data.joints.filter((row) => ["task", "modality", "metric", "scenario"].every((key) => row[key] === chosen[key]));
    const latents = distinct(alike.map((row) => row.latent).filter((latent) => latent !== null));
    const byLatent = chosen.over === "latent";
    const rows = withoutTwins(byLatent ? alike : left);
    const series = byLatent ? latentSeries(rows, directions, latents) : jointSeries(rows, directions);
    const part = chosen.modality === "proprioception" ? "joint" : "link";
    const narrow = place.clientWidth < 480;
    const joints = Array.from({ length: 20 }, (_, joint) => ({ at: joint, text: narrow && joint % 2 ? "" : String(joint) }));
    const x = byLatent
      ? { label: "latent size", low: -0.4, high: latents.length - 0.6, ticks: latents.map((latent, at) => ({ at, text: String(latent) })) }
      : { label: `${part}, 0 at the base, 19 at the tip`, low: -0.5, high: 19.5, ticks: joints };
    chart.show({ x, y: valueAxis(rows, series), series });
  });
}

// --- Prediction over reference ---

function showRegression(place) {
  let chart;
  const inputs = new Map(data.regression.map((cloud) => [cloud.study, cloud.input]));
  const fields = [
    { key: "modality", label: "Of", words: modalityWords },
    { key: "study", label: "Predicted", words: (study) => inputs.get(study) },
    { key: "scenario", label: "Scenario", first: "cluttered" },
    { key: "latent", label: "Latent size", first: sharedLatent(data.regression) },
    { key: "direction", label: "Direction", values: [BOTH, "fe", "aa"], words: (name) => DIRECTIONS[name] ?? name },
  ];
  new Choices(place, data.regression, fields, (chosen, left) => {
    chart ??= new Chart(place, "Prediction over reference");
    const clouds = left.filter((cloud) => chosen.direction === BOTH || directionOf(cloud.index) === chosen.direction);
    const series = clouds.map((cloud) => cloudSeries(cloud));
    // All clouds of a modality and scenario have the same axes, so that they can be compared.
    const alike = data.regression.filter((cloud) => ["modality", "scenario"].every((key) => cloud[key] === chosen[key]));
    const values = alike.flatMap((cloud) => cloud.points.flatMap(([, , reference, predicted]) => [reference, predicted]));
    const [low, high] = [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    const margin = (high - low) * 0.04 || 1;
    const axis = (words) => ({ label: withUnit(words, clouds[0]?.unit ?? "1"), low: low - margin, high: high + margin });
    chart.show({ x: axis("reference"), y: axis("predicted"), square: true, series });
  });
}

function cloudSeries(cloud) {
  const direction = directionOf(cloud.index);
  const part = cloud.modality === "proprioception" ? "joint" : "link";
  const r2 = cloud.r2 ? `, R\u00b2 ${interval(cloud.r2)}` : "";
  // Points are sorted by reference, so that the arrow keys move from left to right.
  const samples = [...cloud.points].sort((a, b) => a[2] - b[2]);
  const points = samples.map(([episode, sample, reference, predicted]) => ({
    x: reference,
    y: predicted,
    says: [
      `reference ${rounded(reference)} ${cloud.unit}`,
      `predicted ${rounded(predicted)} ${cloud.unit}`,
      `episode ${episode}, sample ${sample}, seed ${cloud.seed}`,
    ],
  }));
  return {
    name: `${part} ${cloud.index}, ${DIRECTIONS[direction]}${r2}`,
    look: `cloud ${direction === "fe" ? "third" : "fourth"}`,
    kind: direction === "fe" ? "dot" : "square",
    points,
  };
}

// --- Training ---

const TERMS = { total: "weighted sum", kl: "Kullback-Leibler divergence" };
const termWords = (term) => (Object.hasOwn(TERMS, term) ? TERMS[term] : modalityWords(term));

/** The terms of a loss: the weighted sum first, then the errors, and the divergence last. */
function orderedTerms(terms) {
  const errors = Object.keys(terms).filter((term) => !Object.hasOwn(TERMS, term));
  return ["total", ...errors, "kl"].filter((term) => Object.hasOwn(terms, term));
}

function showTraining(place) {
  const legend = element("ul", { class: "legend" });
  const charts = element("div", { class: "terms" });
  const studies = distinct(data.training.map((row) => row.experiment));
  const wanted = ["multi_to_multi_best", "multi_to_multi", "single_to_multi"];
  const first = wanted.flatMap((study) => studies.filter((name) => name === study || name === `${study}-quick`))[0];
  const fields = [
    { key: "experiment", label: "Experiment", first },
    { key: "task", label: "Task" },
    { key: "run", label: "Run" },
    { key: "scale", label: "Scale", values: ["logarithmic", "linear"] },
  ];
  new Choices(place, data.training, fields, (chosen, [run]) => {
    if (!charts.isConnected) place.append(legend, charts);
    const others = data.training.filter((row) => row !== run && row.experiment === run.experiment && row.task === run.task);
    charts.replaceChildren();
    for (const term of orderedTerms(run.terms)) {
      const figure = element("figure", { "data-term": term }, element("figcaption", {}, termWords(term)));
      charts.append(figure);
      const series = [...others.flatMap((other) => curves(other, term, true)), ...curves(run, term, false)];
      legend.replaceChildren(...legendEntries(series));
      new Chart(figure, `Training curves of the ${termWords(term)}`).show(curveChart(series, term, chosen.scale === "logarithmic"));
      figure.append(element("p", { class: "aside" }, endWords(run.terms[term])));
    }
  });
}

function curveChart(series, term, logarithmic) {
  const points = series.flatMap((one) => one.points).filter((point) => point.y !== null);
  const values = points.map((point) => point.y).filter((value) => !logarithmic || value > 0);
  const most = (values) => values.reduce((a, b) => Math.max(a, b));
  const high = values.length ? most(values) * 1.04 || 1 : 1;
  const least = values.length ? -most(values.map((value) => -value)) : high / 10;
  const low = logarithmic ? least / 1.04 : Math.min(0, least);
  const last = most([2, ...points.map((point) => point.x)]);
  const label = term === "total" || term === "kl" ? "loss" : "error";
  return { small: true, x: { label: "epoch", low: 1, high: last }, y: { label, low, high, logarithmic }, series };
}

/** A run's losses as lines. In the background, lines are pale and have no names. */
function curves(run, term, background) {
  const splits = run.terms[term] ?? {};
  return Object.keys(splits).map((split) => {
    const values = splits[split];
    const points = run.epochs.map((epoch, index) => ({
      x: epoch,
      y: values[index],
      says: [`epoch ${epoch}: ${values[index] === null ? "not finite" : rounded(values[index])}`, run.run],
    }));
    const look = split === "train" ? "first" : "second";
    const name = background ? undefined : splitWords(split);
    return { name, look: `${look} ${background ? "pale" : "chosen"}`, dash: split === "train" ? "" : "dashed", line: true, points };
  });
}

const splitWords = (split) => ({ train: "training" })[split] ?? split;

/**
 * A term's mean over the last tenth of the epochs, and its change from the mean over the tenth before, in words. Epochs
 * without a value are left out.
 */
function endWords(splits) {
  const parts = Object.entries(splits).map(([split, values]) => {
    const tenth = Math.max(1, Math.round(values.length / 10));
    const mean = (from, to) => {
      const there = values.slice(from, to).filter((value) => value !== null);
      return there.reduce((sum, value) => sum + value, 0) / there.length;
    };
    const [end, before] = [mean(values.length - tenth), mean(values.length - 2 * tenth, values.length - tenth)];
    if (Number.isNaN(end)) return `${splitWords(split)} has no value`;
    if (values.length < 2 || !(Math.abs(before) > 0) || !Number.isFinite(end)) return `${splitWords(split)} ${rounded(end)}`;
    const change = 100 * (end / before - 1);
    const sign = change > 0 ? "+" : "";
    return `${splitWords(split)} ${rounded(end)} (${sign}${change.toFixed(1).replace("-", "\u2212")} %)`;
  });
  return `At the end: ${parts.join(", ")}`;
}

// --- The page ---

const parts = { "joints-chart": showJoints, "regression-chart": showRegression, "training-chart": showTraining };
for (const [id, show] of Object.entries(parts)) {
  const place = document.getElementById(id);
  if (place) show(place);
}
for (const clip of data.clips) {
  const figure = document.querySelector(`.clip[data-scenario="${clip.scenario}"]`);
  if (figure) new Clip(figure, clip);
}
}
