"use strict";
// The page: the runs with their curves, the claims, and SQL. Everything is asked from the server of this page.
{
const find = (id) => document.getElementById(id);
/** Time between two looks for changes, ms. */
const POLL = 2000;
/** The most runs whose curves are shown together. */
const MOST_CHOSEN = 8;
/** The columns that are shown at first, besides the overall metrics. */
const FIRST = ["experiment", "run", "status", "scenario", "latent", "variant", "seed", "started", "seconds"];
const MIDDLE_METRICS = ["r2", "smape", "wmape", "relative_error"];
const MODELS = ["network", "persistence", "training_mean", "ridge"];

/** A request without an answer, or with an error as its answer, which then has a status. */
class Failure extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

/** The answer to a request, or null if there is nothing new. Throws a `Failure`. */
async function ask(path, options) {
  let answer, text;
  try {
    answer = await fetch(path, options);
    text = await answer.text();
  } catch {
    throw new Failure("the server does not answer; start `harness serve` again");
  }
  if (answer.status === 304) return null;
  if (!answer.ok) throw new Failure(text, answer.status);
  return JSON.parse(text);
}

/** The message of a failure. Throws other errors again, because those are errors of this page. */
function messageOf(error) {
  if (error instanceof Failure) return error.message;
  throw error;
}

/** Says how the server is, on all tabs. */
const say = (text) => (find("state").textContent = text);
/** Says what is wrong with the filter or the choice of runs, on their tab. */
const note = (text) => (find("note").textContent = text);

// --- The state of the page ---

const state = {
  columns: [], count: 0, version: "", sort: { name: "started", down: true }, group: "", plotted: "", open: new Set(),
  chosen: new Map(), tab: "tab-runs",
  // The last text in the field of the filter that was one.
  filter: "",
  // The status of each run, and the names of all columns so far and of those that are shown.
  statuses: new Map(), known: new Set(), visible: new Set(),
};

/** Writes what is filtered, sorted, grouped, plotted and chosen into the address, so that a link shows the same. */
function remember() {
  // Until the runs are there, the address says what to show.
  if (state.version === "") return;
  const { tab, filter, group, plotted, sort, chosen } = state;
  const words = new URLSearchParams();
  if (tab !== "tab-runs") words.set("tab", tab.replace("tab-", ""));
  for (const [key, value] of Object.entries({ filter, group, plot: plotted })) if (value) words.set(key, value);
  if (sort.name !== "started" || !sort.down) words.set(sort.down ? "down" : "up", sort.name);
  for (const name of chosen.keys()) words.append("run", name);
  history.replaceState(null, "", `${location.pathname}${`#${words}`.replace(/^#$/, "")}`);
}

/** Shows what the address says, once the runs are there. */
function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  find("filter").value = words.get("filter") ?? "";
  const offered = (id, value) => [...find(id).options].some((option) => option.value === value);
  for (const [id, key, name] of [["group", "group", "group"], ["plotted", "plotted", "plot"]]) {
    const value = words.get(name) ?? "";
    if (offered(id, value)) find(id).value = state[key] = value;
  }
  for (const direction of ["up", "down"]) {
    if (named(words.get(direction))) state.sort = { name: words.get(direction), down: direction === "down" };
  }
  return () => {
    for (const name of words.getAll("run")) if (state.statuses.has(name)) choose(name);
    const tab = document.getElementById(`tab-${words.get("tab")}`);
    if (tabs.includes(tab)) open(tab);
  };
}

// --- Tabs ---

const tabs = [...document.querySelectorAll("[role=tab]")];
const opened = {};
function open(tab) {
  state.tab = tab.id;
  for (const other of tabs) {
    const chosen = other === tab;
    other.setAttribute("aria-selected", String(chosen));
    other.tabIndex = chosen ? 0 : -1;
    find(other.getAttribute("aria-controls")).hidden = !chosen;
  }
  opened[tab.getAttribute("aria-controls")]?.();
  remember();
}
for (const [index, tab] of tabs.entries()) {
  tab.addEventListener("click", () => open(tab));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = tabs[(index + step + tabs.length) % tabs.length];
    next.focus();
    open(next);
  });
}

// --- Runs ---

const named = (name) => state.columns.find((column) => column.name === name);
const nameOf = (row) => `${named("experiment").values[row]}/${named("run").values[row]}`;

const table = new BigTable(find("table"), {
  sorted(name) {
    state.sort = { name, down: state.sort.name === name ? !state.sort.down : Boolean(named(name).metric) };
    update();
  },
  toggled(row) {
    if (typeof row === "number") choose(nameOf(row));
    else {
      if (!state.open.delete(row.group)) state.open.add(row.group);
      update();
    }
  },
  isChosen: (row) => state.chosen.has(nameOf(row)),
});

/** The test of each row. If the filter is invalid, that is said, and the last valid one is used. */
function test() {
  try {
    const matches = parseFilter(find("filter").value, state.columns);
    state.filter = find("filter").value;
    note("");
    return matches;
  } catch (error) {
    note(error.message);
  }
  try {
    return parseFilter(state.filter, state.columns);
  } catch {
    // Its column has disappeared together with the last run that had a value.
    return () => true;
  }
}

/** Filters, sorts and groups the rows, and shows them. */
function update() {
  const matches = test();
  const rows = [];
  for (let row = 0; row < state.count; row += 1) if (matches(row)) rows.push(row);
  const column = named(state.sort.name);
  const sign = state.sort.down ? -1 : 1;
  if (column) {
    const { values } = column;
    // Missing values stay last in both directions.
    rows.sort((a, b) => (values[a] === null || values[b] === null ? order(values[a], values[b]) : sign * order(values[a], values[b])));
  }
  const shownColumns = state.columns.filter((column) => state.visible.has(column.name));
  find("count").textContent = `${rows.length} of ${state.count} runs`;
  table.show(shownColumns, state.group ? grouped(rows) : rows, state.sort);
  showGroups(rows);
  remember();
}

/** The rows of each group, in the order of the groups' first rows. */
function groupsOf(rows) {
  const { values } = named(state.group);
  const groups = new Map();
  for (const row of rows) {
    const key = shown(values[row]);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(row);
  }
  return groups;
}

/** The part of a group's width over which the points of its runs are spread. */
const SPREAD = 0.5;
let groupChart;

/** Draws the chosen metric over the groups: each run, and the mean and the standard deviation of each group. */
function showGroups(rows) {
  const metric = named(state.plotted);
  const place = find("plot");
  if (!metric || !named(state.group)) {
    groupChart?.remove();
    groupChart = undefined;
    place.replaceChildren();
    return;
  }
  const measured = rows.filter((row) => typeof metric.values[row] === "number");
  const groups = [...groupsOf(measured)];
  const names = groups.map(([name]) => name);
  const runs = groups.flatMap(([name, rows], at) => rows.map((row, index) => ({
    x: at + SPREAD * ((index + 0.5) / rows.length - 0.5), y: metric.values[row], says: [nameOf(row), `${name}: ${shown(metric.values[row])}`],
  })));
  const means = groups.map(([name, rows], at) => {
    const { mean, deviation } = meanOf(rows.map((row) => metric.values[row]));
    const bounds = deviation === null ? undefined : [mean - deviation, mean + deviation];
    return { x: at, y: mean, bounds, says: [`${name}: ${meanText({ mean, deviation })}`] };
  });
  const content = {
    title: `${metric.name} by ${state.group}`,
    x: { label: state.group, low: -0.5, high: names.length - 0.5, ticks: names.map((text, at) => ({ at, text })) },
    y: { label: metric.name, ...withoutOutliers(runs.map((point) => point.y)) },
    series: [
      { name: "runs", color: COLORS[1], kind: "dot", behind: true, points: runs },
      { name: "mean ± standard deviation", color: COLORS[0], kind: "disc", points: means },
    ],
  };
  if (!groupChart) {
    const box = element("div", { class: "chart" });
    place.replaceChildren(box);
    groupChart = new Chart(box);
  }
  groupChart.show(content);
}

/** The rows by group, in the order of the groups' first rows. The rows of closed groups are left out. */
function grouped(rows) {
  return [...groupsOf(rows)].flatMap(([group, rows]) => {
    const open = state.open.has(group);
    return [{ group, rows, open }, ...(open ? rows : [])];
  });
}

function takeRuns(answer) {
  const first = state.version === "";
  // The metrics follow the columns that name a run and its status.
  const isEarly = (column) => ["experiment", "run", "status"].includes(column.name);
  const [early, late] = [answer.columns.filter(isEarly), answer.columns.filter((column) => !isEarly(column))];
  const columns = [...early, ...late.filter((column) => column.metric), ...late.filter((column) => !column.metric)];
  Object.assign(state, { columns, count: answer.count, version: answer.version });
  for (const column of state.columns) if (column.metric) column.better = column.metric === "r2";
  const isFirst = (column) => FIRST.includes(column.name) || MIDDLE_METRICS.includes(column.metric);
  for (const column of state.columns) {
    if (isFirst(column) && !state.known.has(column.name)) state.visible.add(column.name);
    state.known.add(column.name);
  }
  if (first) {
    find("group").append(new Option("nothing", ""));
    const keys = ["experiment", "scenario", "variant", "input", "output", "latent", "status", "group_hash", "dataset", "host"];
    for (const name of keys) find("group").append(new Option(name === "group_hash" ? "settings without seed" : name, name));
  }
  // Metrics appear with the first run that has them.
  const plotted = ["", ...state.columns.filter((column) => column.metric).map((column) => column.name)];
  find("plotted").replaceChildren(...plotted.map((name) => new Option(name || "nothing", name, false, name === state.plotted)));
  const chooseRuns = first ? recall() : undefined;
  find("choice").querySelector("div").replaceChildren(...state.columns.map((column) => {
    const box = element("input", { type: "checkbox" });
    box.checked = state.visible.has(column.name);
    box.addEventListener("change", () => {
      if (!state.visible.delete(column.name)) state.visible.add(column.name);
      update();
    });
    return element("div", {}, element("label", {}, box, ` ${column.name}`));
  }));
  find("folder").textContent = answer.results;
  find("left-out").hidden = answer.left_out.length === 0;
  find("left-out").textContent = answer.left_out.join(" ");
  const { values: statuses } = named("status");
  state.statuses = new Map(statuses.map((status, row) => [nameOf(row), status]));
  update();
  chooseRuns?.();
  const removed = [...state.chosen.keys()].filter((name) => !state.statuses.has(name));
  if (removed.length) takeAway(removed);
}

find("filter").addEventListener("input", update);
for (const key of ["group", "plotted"]) {
  find(key).addEventListener("change", () => {
    state[key] = find(key).value;
    update();
  });
}

// --- Chosen runs ---

/** Chooses a run, or takes it away if it is chosen. The user may take it away before the server answers. */
async function choose(name) {
  if (!state.chosen.delete(name)) {
    if (state.chosen.size === MOST_CHOSEN) {
      note(`${MOST_CHOSEN} runs are shown at most; click one of them to take it away`);
      return;
    }
    state.chosen.set(name, null);
    table.draw(true);
    try {
      const run = await ask(`/api/run?run=${encodeURIComponent(name)}`);
      if (!state.chosen.has(name)) return;
      state.chosen.set(name, run);
    } catch (error) {
      note(messageOf(error));
      state.chosen.delete(name);
    }
  }
  table.draw(true);
  showChosen();
  remember();
}

/** Takes runs that were removed from the chosen ones. */
function takeAway(names) {
  for (const name of names) state.chosen.delete(name);
  table.draw(true);
  showChosen();
  remember();
}

/** The chosen runs that the server has answered with. */
const chosenRuns = () => [...state.chosen.values()].filter((run) => run);

const column = (columns, name) => columns.find((one) => one.name === name).values;
const rowsOf = (columns) => column(columns, columns[0].name).map((_, row) => Object.fromEntries(columns.map(({ name, values }) => [name, values[row]])));

/** The charts that are shown, those of losses with their task and term. */
let charts = [];

/** The task and the term of each chart of losses that the runs need. */
function lossKinds(runs) {
  const losses = runs.flatMap((run) => rowsOf(run.losses));
  return distinct(losses.map((row) => row.task)).flatMap((task) =>
    distinct(losses.filter((row) => row.task === task).map((row) => row.term)).map((term) => ({ task, term })));
}

/** Adds a chart under its title. */
function addChart(place, content, about = {}) {
  const box = element("div", { class: "chart" }, element("h4", {}, content.title));
  place.append(box);
  const chart = new Chart(box);
  chart.show(content);
  charts.push({ ...about, chart });
}

function showChosen() {
  charts.forEach(({ chart }) => chart.remove());
  charts = [];
  const runs = chosenRuns();
  const place = find("chosen");
  if (runs.length === 0) return place.replaceChildren();
  const parts = element("div");
  place.replaceChildren(parts);
  parts.append(element("h2", {}, runs.length === 1 ? runs[0].name : `${runs.length} runs`));
  for (const run of runs.filter((run) => run.reason)) parts.append(element("p", { class: "problem" }, `${run.name}: ${run.reason}`));
  const curves = element("div", { class: "charts" });
  parts.append(element("h3", {}, "Losses"), hint(), curves);
  for (const kind of lossKinds(runs)) addChart(curves, lossContent(runs, kind), kind);
  if (charts.length === 0) curves.append(element("p", {}, "No epoch has finished yet."));
  parts.append(differences(runs), metricsTable(runs));
  const contents = elementContents(runs);
  const elements = element("div", { class: "charts" });
  if (contents.length) parts.append(element("h3", {}, "By element"), elements);
  for (const content of contents) addChart(elements, content);
  const ahead = horizonContents(runs);
  const horizons = element("div", { class: "charts" });
  if (ahead.length) parts.append(element("h3", {}, "Over the horizon"), horizons);
  for (const content of ahead) addChart(horizons, content);
  parts.append(...runs.map(pictures));
  return undefined;
}

/** A chart of a term's losses. The colors distinguish runs, or the splits of a single run. */
function lossContent(runs, { task, term }) {
  const series = runs.flatMap((run, place) => {
    const rows = rowsOf(run.losses).filter((row) => row.task === task && row.term === term);
    return distinct(rows.map((row) => row.split)).map((split) => ({
      name: runs.length === 1 ? split : `${run.name.split("/")[1]} ${split}`,
      color: COLORS[runs.length === 1 ? Number(split !== "train") : place],
      dash: split === "train" ? "dashed" : undefined,
      line: true,
      points: rows.filter((row) => row.split === split).map((row) => ({ x: row.epoch, y: row.value })),
    }));
  });
  return { title: `${task}: ${term}`, x: { label: "epoch", low: 1, whole: true }, y: { label: "loss", logarithmic: true }, series };
}

/** The settings in which the chosen runs differ. One run has all of its settings. */
function differences(runs) {
  const keys = distinct(runs.flatMap((run) => Object.keys(run.settings))).sort();
  const differing = keys.filter((key) => runs.length === 1 || distinct(runs.map((run) => run.settings[key] ?? "unset")).length > 1);
  const columns = [{ name: "setting", values: differing }, ...runs.map((run) => ({
    name: run.name, values: differing.map((key) => run.settings[key] ?? "unset"),
  }))];
  const title = runs.length === 1 ? "Settings" : "Settings that differ";
  const content = differing.length ? element("div", { class: "scroll" }, plainTable(columns)) : element("p", {}, "None.");
  return element("details", runs.length > 1 ? { open: "" } : {}, element("summary", {}, `${title} (${differing.length})`), content);
}

function metricsTable(runs) {
  const overall = (run) => rowsOf(run.metrics).filter((row) => row.index === null && row.direction === null);
  const key = (row) => [row.task, row.modality, row.metric, row.model].join(" ");
  const keys = distinct(runs.flatMap((run) => overall(run).map(key)));
  const parts = keys.map((text) => text.split(" "));
  const better = parts.map(([, , metric]) => (metric === "r2" ? "higher is better" : "lower is better"));
  const columns = ["task", "modality", "metric", "model"].map((name, index) => ({ name, values: parts.map((part) => part[index]) }));
  columns.push({ name: "direction", values: better });
  for (const run of runs) {
    const values = new Map(overall(run).map((row) => [key(row), row.value]));
    columns.push({ name: run.name, values: keys.map((text) => values.get(text) ?? null) });
  }
  if (keys.length === 0) return element("p", {}, "Metrics appear when the run is done.");
  return element("details", { open: "" }, element("summary", {}, "Metrics on test episodes"), element("div", { class: "scroll" }, plainTable(columns)));
}

/** The lines of a chart, given the rows of each run: those of all models of a single run, or of several networks. */
function linesOf(runs, rows, point) {
  return rows.flatMap((own, place) => {
    // With several runs there would be too many lines for baselines.
    const models = distinct(own.map((row) => row.model)).filter((model) => runs.length === 1 || model === "network");
    return models.map((model) => ({
      name: runs.length === 1 ? model : runs[place].name.split("/")[1],
      color: COLORS[runs.length === 1 ? MODELS.indexOf(model) : place],
      dash: model === "network" ? undefined : "dotted",
      line: true,
      kind: "disc",
      behind: model !== "network",
      points: own.filter((row) => row.model === model).map(point),
    }));
  });
}

/** A chart over the elements, such as joints or links, for each metric and unit of a predicted vector. */
function elementContents(runs) {
  const rows = runs.map((run) => rowsOf(run.metrics).filter((row) => row.index !== null && row.task === "prediction"));
  const kindOf = (row) => JSON.stringify([row.modality, row.metric, row.unit]);
  return distinct(rows.flat().map(kindOf)).map((kind) => {
    const [modality, metric, unit] = JSON.parse(kind);
    const names = runs.find((run) => run.elements[modality])?.elements[modality] ?? [];
    const indices = distinct(rows.flat().filter((row) => kindOf(row) === kind).map((row) => row.index));
    const ticks = indices.map((at) => ({ at, text: names[at] ?? String(at) }));
    const own = rows.map((rows) => rows.filter((row) => kindOf(row) === kind));
    const series = linesOf(runs, own, (row) => ({ x: row.index, y: row.value }));
    const values = series.flatMap((one) => one.points.map((point) => point.y));
    const y = { label: unit === "1" ? metric : `${metric} (${unit})`, ...withoutOutliers(values) };
    return { title: `${modality}: ${metric}`, x: { label: "element", low: indices[0] - 0.5, high: indices.at(-1) + 0.5, ticks }, y, series };
  });
}

/** The metrics over the horizon: the error, and the skill over persistence. */
const OVER_HORIZON = ["r2", "relative_error", "skill"];

/** A chart over the horizon for each modality and metric of runs that predict further than one sample. */
function horizonContents(runs) {
  const rows = runs.map((run) => (run.horizons.length ? rowsOf(run.horizons) : []).filter((row) => OVER_HORIZON.includes(row.metric)));
  const kindOf = (row) => JSON.stringify([row.modality, row.direction, row.metric]);
  const [{ sample_seconds: seconds }] = runs;
  const haveOneRate = runs.every((run) => run.sample_seconds === seconds);
  return distinct(rows.flat().map(kindOf)).map((kind) => {
    const [modality, direction, metric] = JSON.parse(kind);
    const horizons = distinct(rows.flat().filter((row) => kindOf(row) === kind).map((row) => row.horizon));
    const own = rows.map((rows) => rows.filter((row) => kindOf(row) === kind));
    const series = linesOf(runs, own, (row) => ({ x: horizonPlace(row.horizon), y: row.mean }));
    const y = { label: metric, ...withoutOutliers(series.flatMap((one) => one.points.map((point) => point.y))) };
    const title = `${[modality, direction].filter((part) => part).join(" ")}: ${metric}`;
    return { title, x: horizonAxis(horizons, haveOneRate ? seconds : null), y, series };
  });
}

/** The simulated and the predicted images of a few test samples. */
function pictures(run) {
  const frames = rowsOf(run.frames).filter((row) => run.sizes[row.modality]);
  if (frames.length === 0) return "";
  const canvas = (text, [height, width]) => {
    const drawn = element("canvas", { width, height });
    const bytes = Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
    const image = new ImageData(width, height);
    for (let pixel = 0; pixel < width * height; pixel += 1) {
      image.data.set([bytes[3 * pixel], bytes[3 * pixel + 1], bytes[3 * pixel + 2], 255], 4 * pixel);
    }
    drawn.getContext("2d").putImageData(image, 0, 0);
    return drawn;
  };
  const figure = (row) => element("figure", {},
    canvas(row.reference, run.sizes[row.modality]), " ", canvas(row.predicted, run.sizes[row.modality]),
    element("figcaption", {}, `${row.task} ${row.modality}, episode ${row.episode}, sample ${row.sample}`));
  return element("details", {}, element("summary", {}, `Images of ${run.name}: simulated and predicted`),
    element("div", { class: "pictures" }, ...frames.map(figure)));
}

/** Draws the curves of the chosen runs again. The other parts stay, unless the runs need other charts than before. */
function showLosses() {
  const runs = chosenRuns();
  const drawn = charts.filter(({ task }) => task);
  const kinds = drawn.map(({ task, term }) => ({ task, term }));
  if (JSON.stringify(kinds) !== JSON.stringify(lossKinds(runs))) showChosen();
  else for (const { chart, ...kind } of drawn) chart.show(lossContent(runs, kind));
}

/** Asks for what is new of a chosen run, and shows it. The run may be taken away before the server answers. */
async function followRun(name, run) {
  const isChosen = () => state.chosen.get(name) === run;
  const now = await ask(`/api/losses?run=${encodeURIComponent(name)}`);
  if (!isChosen()) return;
  if (now.status !== run.status) {
    const changed = await ask(`/api/run?run=${encodeURIComponent(name)}`);
    if (!isChosen()) return;
    state.chosen.set(name, changed);
    showChosen();
  } else if (JSON.stringify(now.losses) !== JSON.stringify(run.losses)) {
    run.losses = now.losses;
    showLosses();
  }
}

/** Follows the chosen runs that train or have another status than before. Throws the first failure at the end. */
async function follow() {
  let problem;
  for (const [name, run] of state.chosen) {
    const trains = ["running", "interrupted"].includes(run?.status);
    if (!run || (!trains && run.status === state.statuses.get(name))) continue;
    try {
      await followRun(name, run);
    } catch (error) {
      if (!(error instanceof Failure)) throw error;
      if (error.status === 404) takeAway([name]);
      else problem ??= error;
    }
  }
  if (problem) throw problem;
}

// --- Claims ---

/** The version of the runs by which the claims were judged last. */
let judged = "";
let judging = false;

/** Judges the claims while they are visible and the runs have changed since. */
async function judge() {
  if (judging) return;
  judging = true;
  try {
    while (!find("claims").hidden && judged !== state.version) {
      judged = state.version;
      await showClaims();
    }
  } finally {
    judging = false;
  }
}

opened.claims = () => {
  // After a failure, the claims are also judged by the same runs again.
  if (find("claims").querySelector(".problem")) judged = "";
  judge();
};

async function showClaims() {
  const place = find("claims");
  if (!place.querySelector("table")) place.replaceChildren(element("p", {}, "Judging the claims…"));
  try {
    const { columns } = await ask("/api/claims");
    const of = (name) => columns.find((one) => one.name === name).values;
    const table = [
      { name: "claim", values: of("claim").map((claim) => claim.replaceAll("_", " ")) },
      ...["verdict", "scenario"].map((name) => ({ name, values: of(name) })),
      { name: "mean and 95 % interval", values: of("mean").map((mean, row) => interval(mean, of("low")[row], of("high")[row])) },
      { name: "datasets", values: of("datasets") },
      ...["condition", "measured", "paper", "section"].map((name) => ({ name, values: of(name) })),
      { name: "p (Holm)", values: of("p_holm") },
    ];
    const classes = { holds: "verdict-holds", "does not hold": "verdict-fails" };
    const classOf = (column, value) => (column.name === "verdict" ? classes[value] ?? "" : "");
    place.replaceChildren(element("div", { class: "scroll" }, plainTable(table, classOf)));
  } catch (error) {
    place.replaceChildren(element("p", { class: "problem" }, messageOf(error)));
  }
}

// --- SQL ---

opened.sql = async () => {
  if (find("columns").childElementCount) return;
  const tables = await ask("/api/tables");
  find("columns").replaceChildren(...tables.map((table) => element("details", {},
    element("summary", {}, table.name), element("p", {}, table.meaning),
    element("dl", {}, ...table.columns.flatMap((column) => [
      element("dt", {}, column.unit && column.unit !== "1" ? `${column.name} (${column.unit})` : column.name),
      element("dd", {}, column.meaning),
    ])))));
};

/** The number of queries so far. The answer to an earlier query than the last one is not shown. */
let queries = 0;

async function query(event) {
  event.preventDefault();
  queries += 1;
  const own = queries;
  find("asked").textContent = "…";
  find("asked").className = "";
  try {
    const answer = await ask("/api/sql", { method: "POST", body: find("question").value });
    if (own !== queries) return;
    const rows = answer.columns[0]?.values.length ?? 0;
    const more = rows < answer.count ? `, the first ${rows} are shown` : "";
    find("asked").textContent = `${answer.count} ${answer.count === 1 ? "row" : "rows"} in ${shown(answer.seconds)} s${more}`;
    const leftOut = answer.left_out.map((text) => element("p", { class: "problem" }, text));
    find("answer").replaceChildren(...leftOut, plainTable(answer.columns));
  } catch (error) {
    if (own !== queries) return;
    find("asked").className = "problem";
    find("asked").textContent = messageOf(error);
    find("answer").replaceChildren();
  }
}
find("ask").addEventListener("submit", query);
find("question").addEventListener("keydown", (event) => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) query(event);
});

// --- Following ---

async function poll() {
  try {
    const answer = await ask(`/api/runs?version=${state.version}`);
    if (answer) takeRuns(answer);
    judge();
    await follow();
    if (state.problem) say("");
    delete state.problem;
  } catch (error) {
    state.problem = messageOf(error);
    say(state.problem);
  } finally {
    setTimeout(poll, document.hidden ? 5 * POLL : POLL);
  }
}
poll();
}
