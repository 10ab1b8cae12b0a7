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
function addClip(figure, { frames, seconds }) {
  const [still, button, slider, output] = ["img", "button", "input", "output"].map((name) => figure.querySelector(name));
  const [width, height, alt] = ["width", "height", "alt"].map((name) => still.getAttribute(name));
  const canvas = element("canvas", { width, height, role: "img", "aria-label": alt });
  const pen = canvas.getContext("2d");
  const changes = frames.map(({ picture }) => Object.assign(new Image(), { src: `data:image/jpeg;base64,${picture}` }));
  const columns = width / BLOCK;
  const corner = (block) => [(block % columns) * BLOCK, Math.floor(block / columns) * BLOCK];
  function show(frame) {
    slider.value = frame;
    pen.drawImage(still, 0, 0);
    frames[frame].blocks.forEach((block, place) => {
      pen.drawImage(changes[frame], ...corner(place), BLOCK, BLOCK, ...corner(block), BLOCK, BLOCK);
    });
    output.textContent = `${(frame * seconds).toFixed(1)} s`;
    slider.setAttribute("aria-valuetext", output.textContent);
  }
  let timer;
  function toggle() {
    clearInterval(timer);
    timer = timer ? undefined : setInterval(() => show((Number(slider.value) + 1) % frames.length), 1000 * seconds);
    button.textContent = timer ? "Pause" : "Play";
  }
  slider.max = frames.length - 1;
  slider.addEventListener("input", () => show(Number(slider.value)));
  button.addEventListener("click", toggle);
  figure.querySelector(".controls").hidden = false;
  show(0);
  Promise.all([still, ...changes].map((image) => image.decode())).then(() => {
    still.replaceWith(canvas);
    show(Number(slider.value));
  });
}

// --- Choices ---

/**
 * Adds select elements for the fields of rows. Each select offers the values of the rows that match the selects before it. It
 * keeps the chosen value as long as it is offered. Calls `changed` with the chosen values and the rows that match them.
 *
 * A field has a `key` of the rows and a `label`. These are optional: `words` (returns a value's name), `first` (the value
 * chosen at first, or a function of the rows that returns it), `values` (returns the values to choose from, if `key` isn't a
 * key of the rows), `isOptional` (whether the field is hidden unless there are several values), and `unless` (returns
 * whether the field is hidden, given the values chosen before).
 */
function addChoices(place, rows, fields, changed) {
  const parts = fields.map((field) => {
    const change = () => {
      part.chosen = part.offered[part.select.selectedIndex];
      update();
    };
    const select = element("select", { change });
    const part = { words: String, ...field, select, label: element("label", {}, field.label, select) };
    return part;
  });
  function update() {
    let left = rows;
    const chosen = {};
    for (const part of parts) {
      const { key, words } = part;
      part.offered = part.values?.(left) ?? distinct(left.map((row) => row[key]).filter((value) => value !== null));
      part.label.hidden = part.unless?.(chosen) || (part.isOptional && part.offered.length < 2);
      if (part.label.hidden) continue;
      const first = typeof part.first === "function" ? part.first(left) : part.first;
      const wanted = [part.chosen, first].find((value) => part.offered.includes(value)) ?? part.offered[0];
      part.select.replaceChildren(...part.offered.map((value) => new Option(words(value), value, false, value === wanted)));
      chosen[key] = wanted;
      // A row without a value matches every choice. For example, a baseline matches every latent size.
      if (!part.values) left = left.filter((row) => row[key] === null || row[key] === wanted);
    }
    changed(chosen, left);
  }
  place.append(element("div", { class: "choices" }, ...parts.map((part) => part.label)));
  update();
}

/** Adds a chart under choices. `contentOf` returns its content, given the chosen values and the rows that match them. */
function addChart(place, rows, fields, contentOf) {
  let chart;
  addChoices(place, rows, fields, (chosen, left) => {
    if (!chart) {
      chart = new Chart(place);
      place.append(hint());
    }
    chart.show(contentOf(chosen, left));
  });
}

/** The element of the row whose values differ most, such as the link that is touched most. */
function liveliest(rows, valuesOf) {
  const spread = (row) => extent(valuesOf(row)).reduce((low, high) => high - low);
  return rows.reduce((most, row) => (spread(row) > spread(most) ? row : most), rows[0])?.element;
}

// --- Words ---

const BOTH = "both";
const DIRECTIONS = { fe: "flexion/extension", aa: "adduction/abduction" };
const METRICS = { r2: "R\u00b2", rmse: "RMSE", mae: "MAE", smape: "SMAPE", wmape: "WMAPE" };
const MODALITIES = { proprioception: "joint angles", contact_force: "contact forces" };
const spaced = (name) => name.replaceAll("_", " ");
const metricWords = (name) => METRICS[name] ?? spaced(name);
const modalityWords = (name) => MODALITIES[name] ?? spaced(name);
const beforeUnit = (text, unit) => (unit === "1" || unit === "" ? text : `${text} ${unit}`);
const overWords = (over) => (over === "one seed" ? over : `mean over ${over} [95 % interval]`);

/** The choices that several charts offer. */
const FIELDS = {
  modality: { key: "modality", label: "Of", words: modalityWords },
  metric: { key: "metric", label: "Metric", first: "r2", words: metricWords },
  direction: {
    key: "direction", label: "Direction", words: (name) => DIRECTIONS[name] ?? name, isOptional: true,
    values: (left) => (left.some(isOfFinger) ? [BOTH, ...Object.keys(DIRECTIONS)] : []),
  },
};

/** The choice of a study, by the words for its networks. */
function studyField(rows) {
  const inputs = new Map(rows.map((row) => [row.study, row.input]));
  return { key: "study", label: "Predicted", words: (study) => inputs.get(study), isOptional: true };
}

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
    ...lookOfModel(row.model, color),
    name: direction === null ? words : `${words}, ${DIRECTIONS[direction]}`,
    entry: words,
    kind: shapeOf(row.study, direction),
    hollow: lateral,
    ...(row.model === "network" && lateral && { dash: "dashed" }),
  };
}

/** The rows without the same persistence again: it needs no input of the networks, so studies of the same data have the same. */
function withoutTwins(rows) {
  const text = (row) => JSON.stringify([row.values, row.overall]);
  const isTwin = (row, other) => other.model === row.model && text(other) === text(row);
  return rows.filter((row, place) => row.model !== "persistence" || rows.findIndex((other) => isTwin(row, other)) === place);
}

/** The point of a mean with its interval. `says` is before the value in its tooltip, and `more` after it. */
function valuePoint(x, [mean, ...bounds], { metric, unit }, says, more = []) {
  const line = beforeUnit(`${metricWords(metric)} ${interval(mean, ...bounds)}`, unit);
  return { x, y: mean, bounds: bounds.length ? bounds : undefined, says: [says, line, ...more] };
}

/** The networks' means are over seeds, and baselines have none. */
const overOf = (row) => (row.model === "network" ? [overWords(row.over)] : []);

/** The axis of a metric. Its range is chosen for the networks. Baselines beyond it are named below the chart. */
function metricAxis(metric, unit, series) {
  const label = withUnit(metricWords(metric), unit);
  const networks = series.filter((one) => !one.behind);
  const points = (networks.length ? networks : series).flatMap((one) => one.points);
  // The metric isn't defined for any point. For example, a link that is never touched has no percentage.
  if (points.length === 0) return { label, low: 0, high: 1 };
  const ends = points.flatMap((point) => point.bounds ?? [point.y]);
  // R2 and skill have no lower bound, but values below -1 need not be told apart. The skill of persistence is 0.
  const start = metric === "skill" ? 0 : 0.9;
  if (/^skill$|^(log_|trimmed_)?r2(_|$)/.test(metric)) return { label, low: Math.max(-1, Math.floor(Math.min(start, ...ends) * 10) / 10), high: 1 };
  const [, most] = extent(points.map((point) => point.y));
  const [, reach] = extent([...ends, ...series.flatMap((one) => one.points.map((point) => point.y))]);
  return { label, low: 0, high: Math.min(reach, 1.4 * most) * 1.04 || 1 };
}

function jointSeries(rows, directions) {
  return rows.flatMap((row) => directions.map((direction) => {
    const places = row.values.map((value, joint) => ({ value, joint }));
    const some = places.filter(({ value, joint }) => value && row.directions[joint] === direction);
    const cell = row.latent === null ? "" : `, latent size ${row.latent}`;
    const says = (joint) => `${elementWords(row, joint)}${cell}`;
    const points = some.map(({ value, joint }) => valuePoint(joint, value, row, says(joint), overOf(row)));
    return { ...lookOf(row, direction), points };
  })).filter((series) => series.points.length > 0);
}

/** Series over latent sizes, of all joints or links of a direction together. A baseline is the same at every size. */
function latentSeries(rows, directions, latents) {
  const parts = rows.flatMap((row) => directions.map((direction) => {
    // Elements of different units have a value for each unit, and none for all of them.
    const ofAll = row.overall.all ?? row.overall[`in ${row.unit}`] ?? Object.values(row.overall)[0];
    const value = direction === null ? ofAll : row.overall[direction];
    const isFlat = row.latent === null;
    const places = isFlat ? latents.map((_, place) => place) : [latents.indexOf(row.latent)];
    const says = (place) => (isFlat ? "at every latent size" : `latent size ${latents[place]}`);
    const points = value ? places.map((place) => valuePoint(place, value, row, says(place), overOf(row))) : [];
    return { ...lookOf(row, direction), ...(isFlat && { kind: undefined }), study: row.study, points };
  }));
  // Studies on different data have different baselines of the same name.
  const lines = Map.groupBy(parts.filter(({ points }) => points.length > 0), ({ study, name }) => `${study} ${name}`);
  return [...lines.values()].map((parts) => ({ ...parts[0], points: parts.flatMap(({ points }) => points) }));
}

/** The smallest of the latent sizes that the most studies have. */
function sharedLatent(rows) {
  const latents = distinct(rows.map((row) => row.latent).filter((latent) => latent !== null));
  const studies = (latent) => distinct(rows.filter((row) => row.latent === latent).map((row) => row.study)).length;
  return latents.reduce((best, latent) => (studies(latent) > studies(best) ? latent : best), latents[0]);
}

/** Whether a row is about the joints or links of a finger, which have directions. */
const isOfFinger = (row) => (row.directions ?? [row.direction]).some((direction) => direction !== null);

/** The name of a row's element: the number of a finger's joint or link, or the element's own name. */
function elementWords(row, index) {
  if (!isOfFinger(row)) return spaced(row.elements[index]);
  return `${row.modality === "proprioception" ? "joint" : "link"} ${index}`;
}

/** The horizontal axis of a row's elements. */
function elementAxis(row) {
  if (!isOfFinger(row)) return axisOfTexts("element", row.elements.map(spaced));
  const part = row.modality === "proprioception" ? "joint" : "link";
  return axisOfTexts(`${part}, 0 at the base, ${row.values.length - 1} at the tip`, row.values.map((_, index) => String(index)));
}

function showJoints(place) {
  const over = { joint: data.joints.some(isOfFinger) ? "joint or link" : "element", latent: "latent size" };
  const fields = [
    { key: "task", label: "Task" },
    FIELDS.modality,
    FIELDS.metric,
    { key: "unit", label: "Unit", isOptional: true },
    { key: "scenario", label: "Scenario", first: "cluttered" },
    FIELDS.direction,
    { key: "over", label: "Over", values: () => Object.keys(over), words: (name) => over[name] },
    { key: "latent", label: "Latent size", first: sharedLatent(data.joints), unless: (chosen) => chosen.over === "latent" },
  ];
  addChart(place, data.joints, fields, (chosen, left) => {
    const both = { [BOTH]: Object.keys(DIRECTIONS), undefined: [null] };
    const directions = both[chosen.direction] ?? [chosen.direction];
    const keys = ["task", "modality", "metric", "unit", "scenario"].filter((key) => chosen[key] !== undefined);
    const alike = data.joints.filter((row) => keys.every((key) => row[key] === chosen[key]));
    const latents = distinct(alike.map((row) => row.latent).filter((latent) => latent !== null));
    const byLatent = chosen.over === "latent";
    const rows = withoutTwins(byLatent ? alike : left);
    const series = byLatent ? latentSeries(rows, directions, latents) : jointSeries(rows, directions);
    const longest = left.reduce((most, row) => (row.values.length > most.values.length ? row : most), left[0]);
    const x = byLatent ? axisOfTexts("latent size", latents.map(String)) : elementAxis(longest);
    return { title: "Predictions by element", x, y: metricAxis(chosen.metric, rows[0].unit, series), series };
  });
}

// --- Prediction over reference ---

function showRegression(place) {
  const fields = [
    FIELDS.modality,
    studyField(data.regression),
    { key: "scenario", label: "Scenario", first: "cluttered" },
    { key: "latent", label: "Latent size", first: sharedLatent(data.regression) },
    FIELDS.direction,
    {
      key: "element", label: "Element", words: spaced, unless: (chosen) => chosen.direction !== undefined,
      first: (left) => liveliest(left, (cloud) => cloud.points.map((point) => point[2])),
    },
  ];
  addChart(place, data.regression, fields, (chosen, left) => {
    const clouds = left.filter((cloud) => [undefined, BOTH, cloud.direction].includes(chosen.direction));
    // All clouds of a modality and scenario have the same axes, so that they can be compared.
    // Without directions, each element has axes of its own.
    const keys = ["modality", "scenario", "element"].filter((key) => chosen[key] !== undefined);
    const alike = data.regression.filter((cloud) => keys.every((key) => cloud[key] === chosen[key]));
    const range = withMargin(alike.flatMap((cloud) => cloud.points.flatMap(([, , ...values]) => values)));
    const axis = (words) => ({ label: withUnit(words, clouds[0]?.unit ?? "1"), ...range });
    const ends = [range.low, range.high].map((end) => ({ x: end, y: end }));
    const diagonal = { color: "faint", width: 1, line: true, behind: true, points: ends };
    const series = [diagonal, ...clouds.map(cloudSeries)];
    return { title: "Prediction over reference", x: axis("reference"), y: axis("predicted"), square: true, series };
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
      beforeUnit(`reference ${shown(reference)}`, cloud.unit),
      beforeUnit(`predicted ${shown(predicted)}`, cloud.unit),
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
  const fields = [
    studyField(data.course),
    FIELDS.modality,
    { key: "scenario", label: "Scenario" },
    { key: "latent", label: "Latent size" },
    {
      key: "element", label: "Element", words: spaced,
      first: (left) => liveliest(left, (course) => course.points.map((point) => point[1])),
    },
  ];
  addChart(place, data.course, fields, (chosen, [course]) => {
    const { points, seconds, unit } = course;
    const at = (sample) => (seconds === null ? sample : sample * seconds);
    const time = (sample) => (seconds === null ? `sample ${sample}` : `sample ${sample}, ${shown(at(sample))} s`);
    const line = (column, name, look) => ({
      name,
      line: true,
      points: points.map((point) => ({
        x: at(point[0]),
        y: point[column],
        says: [time(point[0]), beforeUnit(`${name} ${shown(point[column])}`, unit), `episode ${course.episode}, seed ${course.seed}`],
      })),
      ...look,
    });
    return {
      title: "Prediction along an episode",
      x: { label: seconds === null ? "sample" : "time since the episode's start (s)" },
      y: { label: withUnit(spaced(course.element), unit), ...withMargin(points.flatMap(([, ...values]) => values), 0.06) },
      series: [line(1, "recorded", { color: "first" }), line(2, "predicted", { color: "second", dash: "dashed" })],
    };
  });
}

// --- Over the horizon ---

function showHorizon(place) {
  const fields = [
    { key: "study", label: "Experiment", isOptional: true },
    { ...FIELDS.modality, first: "contact_force" },
    FIELDS.metric,
    { key: "scenario", label: "Scenario", isOptional: true },
  ];
  addChart(place, data.horizon, fields, (chosen, curves) => {
    const [{ seconds, metric, unit }] = curves;
    const horizons = distinct(curves.flatMap((curve) => curve.points.map(([horizon]) => horizon)));
    const series = curves.map(horizonSeries);
    return { title: "Metric over the horizon", x: horizonAxis(horizons, seconds), y: metricAxis(metric, unit, series), series };
  });
}

function horizonSeries(curve, index) {
  const ahead = (horizon) => (curve.seconds === null ? `${horizon} samples ahead` : `${shown(horizon * curve.seconds)} s ahead`);
  const point = ([horizon, ...value]) => valuePoint(horizonPlace(horizon), value, curve, ahead(horizon), [overWords(curve.over)]);
  const color = curve.model === "persistence" ? "faint" : COLORS[index % COLORS.length];
  return { ...lookOfModel(curve.model, color), name: curve.name, points: curve.points.map(point) };
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
  const legend = new Legend();
  const studies = distinct(data.training.map((row) => row.experiment));
  const wanted = ["multi_to_multi", "single_to_multi"];
  const first = wanted.flatMap((study) => studies.filter((name) => name === study || name === `${study}-quick`))[0];
  const fields = [
    { key: "experiment", label: "Experiment", first },
    { key: "task", label: "Task" },
    { key: "run", label: "Run" },
    { key: "scale", label: "Scale", values: () => ["logarithmic", "linear"] },
  ];
  addChoices(place, data.training, fields, (chosen, [run]) => {
    if (!grid.isConnected) place.append(legend.list, grid, hint());
    const others = data.training.filter((row) => row !== run && row.experiment === run.experiment && row.task === run.task);
    grid.replaceChildren();
    for (const term of orderedTerms(run.terms)) {
      const figure = element("figure", { "data-term": term }, element("figcaption", {}, termWords(term)));
      grid.append(figure);
      const series = [...others.flatMap((other) => curves(other, term, true)), ...curves(run, term, false)];
      const y = { label: Object.hasOwn(TERMS, term) ? "loss" : "error", logarithmic: chosen.scale === "logarithmic" };
      new Chart(figure, legend).show({ title: `Training curves of the ${termWords(term)}`, x: EPOCHS, y, series });
      figure.append(element("p", { class: "aside" }, endWords(run.terms[term])));
    }
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
document.querySelectorAll(".clip").forEach((figure, place) => addClip(figure, data.clips[place]));
}
