"use strict";
// Plays the clips and says what the charts show. The numbers come from the page's JSON element `data`.
{
const data = JSON.parse(document.getElementById("data").textContent);

// --- Clips ---

/** Side of the blocks that pictures consist of, px. */
const BLOCK = 16;

/**
 * Plays a clip's pictures in a loop, at the speed of the simulation. Each picture consists of the first one and of the blocks that
 * differ from it.
 */
class Clip {
  constructor(figure, clip) {
    this.clip = clip;
    this.still = figure.querySelector("img");
    const [width, height, alt] = ["width", "height", "alt"].map((name) => this.still.getAttribute(name));
    this.canvas = element("canvas", { width, height, role: "img", "aria-label": alt });
    this.changes = clip.frames.map(({ picture }) => Object.assign(new Image(), { src: `data:image/jpeg;base64,${picture}` }));
    Promise.all([this.still, ...this.changes].map((image) => image.decode())).then(() => {
      this.still.replaceWith(this.canvas);
      this.show(Number(this.slider.value));
    });
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
    const pen = this.canvas.getContext("2d");
    const columns = this.canvas.width / BLOCK;
    const corner = (block) => [(block % columns) * BLOCK, Math.floor(block / columns) * BLOCK];
    pen.drawImage(this.still, 0, 0);
    this.clip.frames[frame].blocks.forEach((block, place) => {
      pen.drawImage(this.changes[frame], ...corner(place), BLOCK, BLOCK, ...corner(block), BLOCK, BLOCK);
    });
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
      const first = typeof field.first === "function" ? field.first(left) : field.first;
      const wanted = [field.chosen, first].find((value) => field.offered.includes(value)) ?? field.offered[0];
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

/** The element of the row whose values differ most, such as the link that is touched most. */
function liveliest(rows, valuesOf) {
  const spread = (row) => {
    const values = valuesOf(row);
    return values.reduce((a, b) => Math.max(a, b), -Infinity) - values.reduce((a, b) => Math.min(a, b), Infinity);
  };
  return rows.reduce((most, row) => (spread(row) > spread(most) ? row : most), rows[0])?.element;
}

/** Adds a chart that says how it is used. */
function addChart(place) {
  const chart = new Chart(place);
  place.append(hint());
  return chart;
}

// --- Words ---

const DIRECTIONS = { fe: "flexion/extension", aa: "adduction/abduction" };
const METRICS = { r2: "R\u00b2", rmse: "RMSE", mae: "MAE", smape: "SMAPE", wmape: "WMAPE" };
const MODALITIES = { proprioception: "joint angles", contact_force: "contact forces" };
const spaced = (name) => name.replaceAll("_", " ");
const modalityWords = (name) => MODALITIES[name] ?? spaced(name);
const withUnit = (words, unit) => (unit === "1" ? words : `${words} (${unit})`);
const overWords = (over) => (over === "one seed" ? over : `mean over ${over} [95 % interval]`);
/** The shapes of the marks in each direction. Each is for as many studies as there are colors. */
const SHAPES = [{ fe: "disc", aa: "square" }, { fe: "diamond", aa: "diamond" }, { fe: "bar", aa: "bar" }];
const allStudies = distinct([...data.joints, ...data.course].map((row) => row.study));

/** The color of a study's networks, or of its ridge regression, which has another one if there are enough. */
function colorOf(study, isRidge = false) {
  const shift = isRidge && 2 * allStudies.length <= COLORS.length ? Math.max(2, allStudies.length) : 0;
  return COLORS[(allStudies.indexOf(study) + shift) % COLORS.length];
}

/** The shape of a study's marks. Studies of the same color have different ones. */
function shapeOf(study, direction) {
  const round = Math.floor(allStudies.indexOf(study) / COLORS.length);
  return SHAPES[round % SHAPES.length][direction ?? "fe"];
}

// --- By joint and link ---

const BOTH = "both";

/** The name and the look of a row's series in one direction. */
function lookOf(row, direction) {
  const lateral = direction === "aa";
  const looks = {
    network: [row.input, colorOf(row.study)],
    persistence: ["persistence", "faint"],
    ridge: [`ridge regression, ${row.input}`, colorOf(row.study, true)],
  };
  const [words, color] = looks[row.model];
  return {
    name: direction === null ? words : `${words}, ${DIRECTIONS[direction]}`,
    entry: words,
    color,
    dash: row.model !== "network" ? "dotted" : lateral ? "dashed" : undefined,
    kind: shapeOf(row.study, direction),
    hollow: lateral,
    line: true,
    behind: row.model !== "network",
  };
}

/** The rows without the same persistence again: it needs no input of the networks, so studies of the same data have the same. */
function withoutTwins(rows) {
  const text = (row) => JSON.stringify([row.values, row.overall]);
  const isTwin = (row, other) => other.model === row.model && text(other) === text(row);
  return rows.filter((row, place) => row.model !== "persistence" || rows.findIndex((other) => isTwin(row, other)) === place);
}

function valuePoint(x, value, row, says) {
  const unit = row.unit === "1" ? "" : ` ${row.unit}`;
  const line = `${METRICS[row.metric] ?? row.metric} ${interval(...value)}${unit}`;
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
    const some = places.filter(({ value, joint }) => value && row.directions[joint] === direction);
    const cell = row.latent === null ? "" : `, latent size ${row.latent}`;
    const says = (joint) => `${elementWords(row, joint)}${cell}`;
    const points = some.map(({ value, joint }) => valuePoint(joint, value, row, says(joint)));
    return { ...lookOf(row, direction), points };
  })).filter((series) => series.points.length > 0);
}

/** Series over latent sizes, of all joints or links of a direction together. A baseline is the same at every size. */
function latentSeries(rows, directions, latents) {
  const lines = new Map();
  for (const row of rows) {
    for (const direction of directions) {
      // Elements of different units have a value for each unit, and none for all of them.
      const value = direction === null ? row.overall.all ?? row.overall[`in ${row.unit}`] ?? Object.values(row.overall)[0] : row.overall[direction];
      if (!value) continue;
      const look = lookOf(row, direction);
      // Studies on different data have different baselines of the same name.
      const key = `${row.study} ${look.name}`;
      const line = lines.get(key) ?? { ...look, points: [] };
      const places = row.latent === null ? latents.map((_, place) => place) : [latents.indexOf(row.latent)];
      const says = (place) => (row.latent === null ? "at every latent size" : `latent size ${latents[place]}`);
      line.points.push(...places.map((place) => valuePoint(place, value, row, says(place))));
      if (row.latent === null) line.kind = undefined;
      lines.set(key, line);
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

/** Whether a row is about the joints or links of a finger, which have directions. */
const isOfFinger = (row) => row.directions.some((direction) => direction !== null);

/** The name of a row's element: the number of a finger's joint or link, or the element's own name. */
function elementWords(row, index) {
  if (!isOfFinger(row)) return spaced(row.elements[index]);
  return `${row.modality === "proprioception" ? "joint" : "link"} ${index}`;
}

/** The most elements whose names fit below a chart, and the most letters of all of them. */
const [MOST_NAMES, MOST_LETTERS] = [8, 60];

/** The horizontal axis of a row's elements: by their numbers, or by their names if these fit. */
function elementAxis(row) {
  const last = row.values.length - 1;
  const range = { low: -0.5, high: last + 0.5 };
  const names = isOfFinger(row) ? [] : row.elements.map(spaced);
  const fit = names.length > 0 && names.length <= MOST_NAMES && names.join("").length <= MOST_LETTERS;
  const ticks = row.values.map((_, index) => ({ at: index, text: fit ? names[index] : String(index) }));
  if (!isOfFinger(row)) return { label: fit ? "element" : "element, by number", ticks, ...range };
  const part = row.modality === "proprioception" ? "joint" : "link";
  return { label: `${part}, 0 at the base, ${last} at the tip`, ticks, ...range };
}

function showJoints(place) {
  let chart;
  const over = { joint: data.joints.some(isOfFinger) ? "joint or link" : "element", latent: "latent size" };
  const unitsOf = (chosen) => {
    const alike = ["task", "modality", "metric"];
    return distinct(data.joints.filter((row) => alike.every((key) => row[key] === chosen[key])).map((row) => row.unit));
  };
  const hasDirections = (chosen) => data.joints.some((row) => row.modality === chosen.modality && isOfFinger(row));
  const fields = [
    { key: "task", label: "Task" },
    { key: "modality", label: "Of", words: modalityWords },
    { key: "metric", label: "Metric", first: "r2", words: (name) => METRICS[name] ?? spaced(name) },
    { key: "unit", label: "Unit", unless: (chosen) => unitsOf(chosen).length < 2 },
    { key: "scenario", label: "Scenario", first: "cluttered" },
    {
      key: "direction", label: "Direction", values: [BOTH, "fe", "aa"], words: (name) => DIRECTIONS[name] ?? name,
      unless: (chosen) => !hasDirections(chosen),
    },
    { key: "over", label: "Over", values: Object.keys(over), words: (name) => over[name] },
    { key: "latent", label: "Latent size", first: sharedLatent(data.joints), unless: (chosen) => chosen.over === "latent" },
  ];
  new Choices(place, data.joints, fields, (chosen, left) => {
    chart ??= addChart(place);
    const both = { [BOTH]: Object.keys(DIRECTIONS), undefined: [null] };
    const directions = both[chosen.direction] ?? [chosen.direction];
    const keys = ["task", "modality", "metric", "unit", "scenario"].filter((key) => chosen[key] !== undefined);
    const alike = data.joints.filter((row) => keys.every((key) => row[key] === chosen[key]));
    const latents = distinct(alike.map((row) => row.latent).filter((latent) => latent !== null));
    const byLatent = chosen.over === "latent";
    const rows = withoutTwins(byLatent ? alike : left);
    const series = byLatent ? latentSeries(rows, directions, latents) : jointSeries(rows, directions);
    const longest = left.reduce((most, row) => (row.values.length > most.values.length ? row : most), left[0]);
    const x = byLatent
      ? { label: "latent size", low: -0.4, high: latents.length - 0.6, ticks: latents.map((latent, at) => ({ at, text: String(latent) })) }
      : elementAxis(longest);
    chart.show({ title: "Predictions by element", x, y: valueAxis(rows, series), series });
  });
}

// --- Prediction over reference ---

function showRegression(place) {
  let chart;
  const inputs = new Map(data.regression.map((cloud) => [cloud.study, cloud.input]));
  const hasDirections = (chosen) => data.regression.some((cloud) => cloud.modality === chosen.modality && cloud.direction !== null);
  const fields = [
    { key: "modality", label: "Of", words: modalityWords },
    { key: "study", label: "Predicted", words: (study) => inputs.get(study), unless: () => inputs.size < 2 },
    { key: "scenario", label: "Scenario", first: "cluttered" },
    { key: "latent", label: "Latent size", first: sharedLatent(data.regression) },
    {
      key: "direction", label: "Direction", values: [BOTH, "fe", "aa"], words: (name) => DIRECTIONS[name] ?? name,
      unless: (chosen) => !hasDirections(chosen),
    },
    {
      key: "element", label: "Element", words: spaced, unless: hasDirections,
      first: (left) => liveliest(left, (cloud) => cloud.points.map((point) => point[2])),
    },
  ];
  new Choices(place, data.regression, fields, (chosen, left) => {
    chart ??= addChart(place);
    const clouds = left.filter((cloud) => [undefined, BOTH, cloud.direction].includes(chosen.direction));
    const series = clouds.map((cloud) => cloudSeries(cloud));
    // All clouds of a modality and scenario have the same axes, so that they can be compared.
    // Without directions, each element has axes of its own.
    const keys = ["modality", "scenario", "element"].filter((key) => chosen[key] !== undefined);
    const alike = data.regression.filter((cloud) => keys.every((key) => cloud[key] === chosen[key]));
    const values = alike.flatMap((cloud) => cloud.points.flatMap(([, , reference, predicted]) => [reference, predicted]));
    const [low, high] = [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    const margin = (high - low) * 0.04 || 1;
    const axis = (words) => ({ label: withUnit(words, clouds[0]?.unit ?? "1"), low: low - margin, high: high + margin });
    chart.show({ title: "Prediction over reference", x: axis("reference"), y: axis("predicted"), square: true, series });
  });
}

function cloudSeries(cloud) {
  const { direction } = cloud;
  const part = cloud.modality === "proprioception" ? "joint" : "link";
  const name = direction === null ? spaced(cloud.element) : `${part} ${cloud.index}, ${DIRECTIONS[direction]}`;
  const r2 = cloud.r2 ? `, R\u00b2 ${interval(...cloud.r2)}` : "";
  // Points are sorted by reference, so that the arrow keys move from left to right.
  const samples = [...cloud.points].sort((a, b) => a[2] - b[2]);
  const points = samples.map(([episode, sample, reference, predicted]) => ({
    x: reference,
    y: predicted,
    says: [
      `reference ${shown(reference)} ${cloud.unit}`,
      `predicted ${shown(predicted)} ${cloud.unit}`,
      `episode ${episode}, sample ${sample}, seed ${cloud.seed}`,
    ],
  }));
  return {
    name: `${name}${r2}`,
    color: direction === "aa" ? "fourth" : "third",
    alpha: 0.5,
    kind: direction === "aa" ? "square" : "dot",
    points,
  };
}

// --- Over time ---

function showCourse(place) {
  let chart;
  const inputs = new Map(data.course.map((course) => [course.study, course.input]));
  const fields = [
    { key: "study", label: "Predicted", words: (study) => inputs.get(study), unless: () => inputs.size < 2 },
    { key: "modality", label: "Of", words: modalityWords },
    { key: "scenario", label: "Scenario" },
    { key: "latent", label: "Latent size" },
    {
      key: "element", label: "Element", words: spaced,
      first: (left) => liveliest(left, (course) => course.points.map((point) => point[1])),
    },
  ];
  new Choices(place, data.course, fields, (chosen, [course]) => {
    chart ??= addChart(place);
    const at = (sample) => (course.seconds === null ? sample : sample * course.seconds);
    const time = (sample) => (course.seconds === null ? `sample ${sample}` : `sample ${sample}, ${shown(at(sample))} s`);
    const unit = course.unit === "" || course.unit === "1" ? "" : ` ${course.unit}`;
    const line = (column, words, look) => ({
      name: words,
      line: true,
      points: course.points.map((point) => ({
        x: at(point[0]),
        y: point[column],
        says: [time(point[0]), `${words} ${shown(point[column])}${unit}`, `episode ${course.episode}, seed ${course.seed}`],
      })),
      ...look,
    });
    const ends = [course.points[0][0], course.points[course.points.length - 1][0]].map(at);
    const values = course.points.flatMap(([, reference, predicted]) => [reference, predicted]);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const margin = (high - low) * 0.06 || 1;
    chart.show({
      title: "Prediction along an episode",
      x: { label: course.seconds === null ? "sample" : "time since the episode's start (s)", low: ends[0], high: ends[1] },
      y: { label: withUnit(spaced(course.element), course.unit || "1"), low: low - margin, high: high + margin },
      series: [
        line(1, "recorded", { color: "first" }),
        line(2, "predicted", { color: "second", dash: "dashed" }),
      ],
    });
  });
}

// --- Over the horizon ---

function showHorizon(place) {
  let chart;
  const studies = distinct(data.horizon.map((curve) => curve.study));
  const scenarios = distinct(data.horizon.map((curve) => curve.scenario));
  const fields = [
    { key: "study", label: "Experiment", unless: () => studies.length < 2 },
    { key: "modality", label: "Of", first: "contact_force", words: modalityWords },
    { key: "metric", label: "Metric", first: "r2", words: (name) => METRICS[name] ?? spaced(name) },
    { key: "scenario", label: "Scenario", unless: () => scenarios.length < 2 },
  ];
  new Choices(place, data.horizon, fields, (chosen, curves) => {
    chart ??= addChart(place);
    const { seconds, metric, unit } = curves[0];
    const horizons = distinct(curves.flatMap((curve) => curve.points.map(([horizon]) => horizon)));
    const series = curves.map((curve, index) => horizonSeries(curve, index));
    const { label, ...range } = valueAxis([{ metric, unit }], series);
    const y = metric === "skill" ? { label, ...skillRange(series) } : { label, ...range };
    chart.show({ title: "Metric over the horizon", x: horizonAxis(horizons, seconds), y, series });
  });
}

function horizonSeries(curve, index) {
  const isBaseline = ["persistence", "ridge", "training_mean", "nearest_neighbors"].includes(curve.model);
  const unit = curve.unit === "1" ? "" : ` ${curve.unit}`;
  const ahead = (horizon) => (curve.seconds === null ? `${horizon} samples ahead` : `${shown(horizon * curve.seconds)} s ahead`);
  const points = curve.points.map(([horizon, mean, ...bounds]) => ({
    x: horizonPlace(horizon),
    y: mean,
    bounds: bounds.length ? bounds : undefined,
    says: [ahead(horizon), `${METRICS[curve.metric] ?? spaced(curve.metric)} ${interval(mean, ...bounds)}${unit}`, overWords(curve.over)],
  }));
  return {
    name: curve.name,
    color: curve.model === "persistence" ? "faint" : COLORS[index % COLORS.length],
    dash: isBaseline ? "dotted" : undefined,
    kind: isBaseline ? "diamond" : "disc",
    line: true,
    behind: isBaseline,
    points,
  };
}

/** The ends of an axis of skills: 0, which is persistence, to at most 1, and at least the skills of networks above -1. */
function skillRange(series) {
  const ends = series.filter((one) => !one.behind).flatMap((one) => one.points.map((point) => point.y));
  return { low: Math.max(-1, Math.floor(Math.min(0, ...ends) * 10) / 10), high: 1 };
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
  const grid = element("div", { class: "terms" });
  const hidden = new Set();
  let charts = [];
  const legend = new Legend(hidden, () => charts.forEach((chart) => chart.hideSeries()));
  const studies = distinct(data.training.map((row) => row.experiment));
  const wanted = ["multi_to_multi", "single_to_multi"];
  const first = wanted.flatMap((study) => studies.filter((name) => name === study || name === `${study}-quick`))[0];
  const fields = [
    { key: "experiment", label: "Experiment", first },
    { key: "task", label: "Task" },
    { key: "run", label: "Run" },
    { key: "scale", label: "Scale", values: ["logarithmic", "linear"] },
  ];
  new Choices(place, data.training, fields, (chosen, [run]) => {
    if (!grid.isConnected) place.append(legend.list, grid, hint());
    const others = data.training.filter((row) => row !== run && row.experiment === run.experiment && row.task === run.task);
    charts.forEach((chart) => chart.remove());
    grid.replaceChildren();
    charts = orderedTerms(run.terms).map((term) => {
      const figure = element("figure", { "data-term": term }, element("figcaption", {}, termWords(term)));
      grid.append(figure);
      const series = [...others.flatMap((other) => curves(other, term, true)), ...curves(run, term, false)];
      legend.show(series);
      const chart = new Chart(figure, { small: true, hidden });
      chart.show({
        title: `Training curves of the ${termWords(term)}`,
        x: { label: "epoch", low: 1, whole: true },
        y: { label: term === "total" || term === "kl" ? "loss" : "error", logarithmic: chosen.scale === "logarithmic" },
        series,
      });
      figure.append(element("p", { class: "aside" }, endWords(run.terms[term])));
      return chart;
    });
  });
}

/** A run's losses as lines. In the background, lines are pale and have no names. */
function curves(run, term, background) {
  const splits = run.terms[term] ?? {};
  return Object.keys(splits).map((split) => {
    const values = splits[split];
    const points = run.epochs.map((epoch, index) => ({
      x: epoch,
      y: values[index],
      says: [`epoch ${epoch}: ${shown(values[index])}`, run.run],
    }));
    const color = split === "train" ? "first" : "second";
    const look = background ? { alpha: 0.2, width: 1 } : { name: splitWords(split), width: 2.6 };
    return { ...look, entry: splitWords(split), color, dash: split === "train" ? undefined : "dashed", line: true, points };
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
    if (values.length < 2 || !(Math.abs(before) > 0) || !Number.isFinite(end)) return `${splitWords(split)} ${shown(end)}`;
    const change = 100 * (end / before - 1);
    const sign = change > 0 ? "+" : "";
    return `${splitWords(split)} ${shown(end)} (${sign}${change.toFixed(1).replace("-", "\u2212")} %)`;
  });
  return `At the end: ${parts.join(", ")}`;
}

// --- The page ---

const parts = {
  "joints-chart": showJoints,
  "regression-chart": showRegression,
  "course-chart": showCourse,
  "horizon-chart": showHorizon,
  "training-chart": showTraining,
};
for (const [id, show] of Object.entries(parts)) {
  const place = document.getElementById(id);
  if (place) show(place);
}
document.querySelectorAll(".clip").forEach((figure, place) => new Clip(figure, data.clips[place]));
}
