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
const BASELINES = ["persistence", "training_mean", "ridge", "nearest_neighbors"];

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
  // The column or setting over which the plot is.
  over: "",
  // How much the curves of losses are smoothed: the weight of the earlier epochs, from 0 to 0.95.
  smooth: 0,
  // The experiment that is compared, and the name of the row of its table that is drawn.
  compared: "", drawn: "",
  // The last text in the field of the filter that was one.
  filter: "",
  // The status of each run, and the names of all columns so far and of those that are shown.
  statuses: new Map(), known: new Set(), visible: new Set(),
};

/** Writes what is filtered, sorted, grouped, plotted, compared and chosen into the address, so that a link shows the same. */
function remember() {
  // Until the runs are there, the address says what to show.
  if (state.version === "") return;
  const { tab, filter, group, plotted, over, compared, drawn, smooth, sort, chosen } = state;
  const words = new URLSearchParams();
  if (tab !== "tab-runs") words.set("tab", tab.replace("tab-", ""));
  const fields = { filter, group, plot: plotted, over, compare: compared, draw: compared && drawn, smooth };
  for (const [key, value] of Object.entries(fields)) if (value) words.set(key, value);
  if (sort.name !== "started" || !sort.down) words.set(sort.down ? "down" : "up", sort.name);
  for (const name of chosen.keys()) words.append("run", name);
  history.replaceState(null, "", `${location.pathname}${`#${words}`.replace(/^#$/, "")}`);
}

/** Whether a select has an option. */
const offers = (id, value) => [...find(id).options].some((option) => option.value === value);

/** Shows what the address says, once the runs are there. */
function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  find("filter").value = words.get("filter") ?? "";
  const fields = [["group", "group"], ["plotted", "plot"], ["over", "over"], ["compared", "compare"]];
  const take = ([id, name]) => {
    const value = words.get(name) ?? "";
    if (offers(id, value)) find(id).value = state[id] = value;
  };
  fields.forEach(take);
  // The address may name settings, which are not there yet.
  const wanted = fields.filter(([id, name]) => BY_SETTING.includes(id) && (words.get(name) ?? "") !== state[id]);
  if (wanted.length) askSettings().then(() => {
    wanted.forEach(take);
    update();
  });
  state.drawn = words.get("draw") ?? "";
  state.smooth = Math.min(Math.max(Number(words.get("smooth")) || 0, 0), MOST_SMOOTH);
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
/** The column or the setting of this name. */
const columnOf = (name) => named(name) ?? settings.columns.find((column) => column.name === name);
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
  table.show(shownColumns, columnOf(state.group) ? grouped(rows) : rows, state.sort);
  showGroups(rows);
  remember();
}

/** The rows of each value of a column, in the order of the values' first rows. */
function groupsOf(rows, { values }) {
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

/** Draws the chosen metric over a setting or over the groups: each run, and means with standard deviations. */
function showGroups(rows) {
  const [metric, over, group] = [named(state.plotted), columnOf(state.over), columnOf(state.group)];
  const place = find("plot");
  if (!metric || !(over ?? group)) {
    groupChart?.remove();
    groupChart = undefined;
    place.replaceChildren();
    return;
  }
  const measured = rows.filter((row) => typeof metric.values[row] === "number");
  const numeric = over && measured.some((row) => over.values[row] !== null) &&
    measured.every((row) => over.values[row] === null || typeof over.values[row] === "number");
  const content = numeric ? numericContent(measured, metric, over, group) : categoryContent(measured, metric, over ?? group);
  if (!groupChart) {
    const box = element("div", { class: "chart" });
    place.replaceChildren(box);
    groupChart = new Chart(box);
  }
  groupChart.show(content);
}

/** The mean of a metric over runs at a place of a chart, with the standard deviation. */
function meanPoint(rows, metric, x, name) {
  const { mean, deviation } = meanOf(rows.map((row) => metric.values[row]));
  const bounds = deviation === null ? undefined : [mean - deviation, mean + deviation];
  return { x, y: mean, bounds, says: [`${name}: ${meanText({ mean, deviation })}`] };
}

/** A chart of a metric over the values of a column, which are beside each other. */
function categoryContent(rows, metric, column) {
  const groups = [...groupsOf(rows, column)];
  const runs = groups.flatMap(([name, rows], at) => rows.map((row, index) => ({
    x: at + SPREAD * ((index + 0.5) / rows.length - 0.5), y: metric.values[row], says: [nameOf(row), `${name}: ${shown(metric.values[row])}`],
  })));
  return {
    title: `${metric.name} by ${column.name}`,
    x: { label: column.name, low: -0.5, high: groups.length - 0.5, ticks: groups.map(([text], at) => ({ at, text })) },
    y: { label: metric.name, ...withoutOutliers(runs.map((point) => point.y)) },
    series: [
      { name: "runs", color: COLORS[1], kind: "dot", behind: true, points: runs },
      { name: MEANS, color: COLORS[0], kind: "disc", points: groups.map(([name, rows], at) => meanPoint(rows, metric, at, name)) },
    ],
  };
}

const MEANS = "mean ± standard deviation";
/** An axis is logarithmic if its largest value is more than so many times its smallest. */
const WIDE = 100;

/** A chart of a metric over a number of each run, with a line for each group. */
function numericContent(rows, metric, over, group) {
  const there = rows.filter((row) => over.values[row] !== null);
  const values = distinct(there.map((row) => over.values[row]));
  const [least, most] = [values[0], values.at(-1)];
  const isWide = least > 0 && most / least > WIDE;
  const at = isWide ? Math.log10 : (value) => value;
  const margin = 0.04 * (at(most) - at(least)) || 0.5;
  const groups = group ? [...groupsOf(there, group)] : [[MEANS, there]];
  const series = groups.flatMap(([name, rows], place) => {
    const [own, behind] = group ? [place, place] : [0, 1];
    const says = (row) => [nameOf(row), `${over.name} ${shown(over.values[row])}: ${shown(metric.values[row])}`];
    const points = rows.map((row) => ({ x: at(over.values[row]), y: metric.values[row], says: says(row) }));
    const byValue = values.map((value) => [value, rows.filter((row) => over.values[row] === value)]).filter(([, rows]) => rows.length);
    const means = byValue.map(([value, rows]) => meanPoint(rows, metric, at(value), `${over.name} ${shown(value)}`));
    return [
      { name: group ? name : "runs", color: COLORS[behind % COLORS.length], kind: "dot", behind: true, alpha: 0.6, points },
      { name, color: COLORS[own % COLORS.length], kind: "disc", line: true, points: means },
    ];
  });
  return {
    title: `${metric.name} over ${over.name}`,
    x: {
      label: over.name, low: at(least) - margin, high: at(most) + margin,
      ...(isWide && { ticks: logarithmicTicks(least, most).map((value) => ({ at: at(value), text: shown(value) })) }),
    },
    y: { label: metric.name, ...withoutOutliers(there.map((row) => metric.values[row])) },
    series,
  };
}

/** The rows by group, in the order of the groups' first rows. The rows of closed groups are left out. */
function grouped(rows) {
  return [...groupsOf(rows, columnOf(state.group))].flatMap(([group, rows]) => {
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
  alignSettings();
  const isFirst = (column) => FIRST.includes(column.name) || MIDDLE_METRICS.includes(column.metric);
  for (const column of state.columns) {
    if (!isFirst(column)) continue;
    if (!state.known.has(column.name)) state.visible.add(column.name);
    state.known.add(column.name);
  }
  if (first) {
    find("group").append(new Option("nothing", ""));
    const keys = ["experiment", "scenario", "variant", "input", "output", "latent", "status", "group_hash", "dataset", "host"];
    for (const name of keys) find("group").append(new Option(name === "group_hash" ? "settings without seed" : name, name));
    find("over").append(new Option("the groups", ""), ...OVER.map((name) => new Option(name)));
  }
  // Metrics appear with the first run that has them.
  const plotted = ["", ...state.columns.filter((column) => column.metric).map((column) => column.name)];
  const offer = (id, names) => find(id).replaceChildren(...names.map((name) => new Option(name || "nothing", name, false, name === state[id])));
  offer("plotted", plotted);
  const { values: status } = named("status");
  const experiments = distinct(named("experiment").values.filter((_, row) => status[row] === "done"));
  if (!experiments.includes(state.compared)) state.compared = "";
  offer("compared", ["", ...experiments]);
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
  state.statuses = new Map(status.map((status, row) => [nameOf(row), status]));
  update();
  compare();
  if (BY_SETTING.some((id) => state[id] && !named(state[id]))) askSettings().then(update);
  chooseRuns?.();
  const removed = [...state.chosen.keys()].filter((name) => !state.statuses.has(name));
  if (removed.length) takeAway(removed);
}

find("filter").addEventListener("input", update);
for (const key of ["group", "plotted", "over"]) {
  find(key).addEventListener("change", () => {
    state[key] = find(key).value;
    update();
  });
}

find("compared").addEventListener("change", () => {
  Object.assign(state, { compared: find("compared").value, drawn: "" });
  remember();
  compare();
});

// --- Settings ---

/** The selects that offer the settings in which runs differ. */
const BY_SETTING = ["group", "over"];
/** The columns of runs over which a metric can be plotted. */
const OVER = ["latent", "seed", "parameters", "seconds"];
/**
 * The settings in which runs differ. They are asked for when a reader needs them, because those of many runs take long.
 * `columns` have a value for each row.
 */
const settings = { version: "", asked: null, answer: null, columns: [] };

/** Asks for the settings of the present runs, unless they were asked for. The promise ends when they are offered. */
function askSettings() {
  if (settings.version !== state.version) Object.assign(settings, { version: state.version, asked: offerSettings() });
  return settings.asked;
}

async function offerSettings() {
  try {
    settings.answer = await ask("/api/settings");
  } catch (error) {
    settings.version = "";
    note(messageOf(error));
    return;
  }
  alignSettings();
  for (const id of BY_SETTING) {
    find(id).querySelector("optgroup")?.remove();
    const options = settings.columns.map(({ name }) => new Option(name, name, false, name === state[id]));
    find(id).append(element("optgroup", { label: "settings" }, ...options));
  }
}

/** A number, also if it is the only item of a list, such as `[64]`. Other texts stay as they are. */
function numberIn(text) {
  const number = Number(/^\[(.*)\]$/.exec(text)?.[1] ?? text);
  return text.trim() === "" || Number.isNaN(number) ? text : number;
}

/** Gives each row its values of the settings. Runs that are newer than the settings have none. */
function alignSettings() {
  if (!settings.answer) return;
  const places = new Map(settings.answer.runs.map((name, place) => [name, place]));
  const rows = Array.from({ length: state.count }, (_, row) => places.get(nameOf(row)));
  const own = settings.answer.settings.filter(({ name }) => !named(name));
  settings.columns = own.map(({ name, choices, places }) => {
    const values = choices.map(numberIn);
    return { name, values: rows.map((place) => values[places[place]] ?? null) };
  });
}

for (const id of BY_SETTING) {
  for (const event of ["focus", "pointerenter"]) find(id).addEventListener(event, () => void askSettings());
}

// --- The table and a figure of an experiment ---

/** The experiment and the version of the runs that were compared last. */
let comparedLast = "";
let comparisonChart;

/** Compares the networks of an experiment with each other and with baselines, unless the page shows that already. */
async function compare() {
  const own = JSON.stringify([state.compared, state.compared && state.version]);
  if (comparedLast === own) return;
  comparedLast = own;
  let parts = [];
  if (state.compared) {
    try {
      const answer = await ask(`/api/compare?experiment=${encodeURIComponent(state.compared)}`);
      parts = [() => showComparison(answer)];
    } catch (error) {
      parts = [() => find("comparison").append(element("p", { class: "problem" }, messageOf(error)))];
    }
  }
  // The user may have chosen another experiment before the server answered.
  if (comparedLast !== own) return;
  comparisonChart?.remove();
  comparisonChart = undefined;
  find("comparison").replaceChildren();
  parts.forEach((show) => show());
}

/** A row of a table of a comparison in words. */
const rowWords = (table, row) => [row.modality, row.metric, table.scenario, table.task, table.settings].filter((word) => word).join(", ");

function showComparison({ tables, notes }) {
  const place = find("comparison");
  place.append(element("h2", {}, state.compared), ...notes.map((text) => element("p", {}, text)));
  const rows = tables.flatMap((table) => table.rows.map((row) => ({ table, row, name: rowWords(table, row) })));
  const [first] = rows;
  const select = element("select");
  select.append(...rows.map(({ name }) => new Option(name, name, false, name === state.drawn)));
  const box = element("div", { class: "chart" });
  const draw = () => {
    const { table, row } = rows.find(({ name }) => name === select.value) ?? first;
    comparisonChart.show(comparisonContent(table, row));
  };
  select.addEventListener("change", () => {
    state.drawn = select.value;
    remember();
    draw();
  });
  place.append(element("div", { class: "controls" }, element("label", {}, "Figure of ", select)), box, ...tables.map(comparisonTable));
  comparisonChart = new Chart(box);
  draw();
}

/** A table of networks and baselines, under its title. The best value of each row is bold. */
function comparisonTable(table) {
  const heads = ["modality", "metric", ...table.columns.map((column) => column.name)];
  const head = heads.map((name, place) => element("th", { scope: "col", class: place > 1 ? "number" : "" }, name));
  const cell = (one) => element("td", { class: "number" }, one?.is_best ? element("b", {}, one.text) : one?.text ?? "");
  const rows = table.rows.map((row) => element("tr", {},
    element("td", {}, row.modality), element("td", {}, row.metric + betterArrow(row.better)), ...row.cells.map(cell)));
  const title = [table.scenario, table.task, table.settings].filter((word) => word).join(", ");
  const over = table.over ? `± is half of the 95 % interval over ${table.over}.` : "Each value is of one run.";
  return element("div", {}, element("h3", {}, title),
    element("div", { class: "scroll" }, element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows))),
    element("p", { class: "hint" }, over));
}

/** The ends of an axis for networks, and for those baselines that are near them. The others are named as beyond it. */
function aroundNetworks(networks, baselines) {
  if (networks.length === 0) return {};
  const ends = networks.flatMap((point) => [point.y, ...(point.bounds ?? [])]);
  const [min, max] = [Math.min(...ends), Math.max(...ends)];
  const room = max - min || 0.1 * Math.abs(max) || 1;
  const near = baselines.map((point) => point.y).filter((y) => y >= min - room && y <= max + room);
  const [least, most] = [Math.min(min, ...near), Math.max(max, ...near)];
  return { low: least - 0.05 * (most - least || room), high: most + 0.05 * (most - least || room) };
}

/** A chart of a row of a comparison: the mean of each column, with its interval. */
function comparisonContent(table, row) {
  const points = (isBaseline) => row.cells.flatMap((cell, at) => (cell && table.columns[at].is_baseline === isBaseline
    ? [{ x: at, y: cell.mean, bounds: cell.bounds ?? undefined, says: [`${table.columns[at].name}: ${cell.text}`] }] : []));
  const [networks, baselines] = [points(false), points(true)];
  return {
    title: rowWords(table, row),
    x: {
      label: "network or baseline", low: -0.5, high: table.columns.length - 0.5,
      ticks: table.columns.map(({ name }, at) => ({ at, text: name })),
    },
    y: { label: row.metric, ...aroundNetworks(networks, baselines) },
    series: [
      { name: "baselines", color: COLORS[1], kind: "diamond", behind: true, points: baselines },
      { name: "networks", color: COLORS[0], kind: "disc", points: networks },
    ],
  };
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
  parts.append(element("div", { class: "controls" }, element("h3", {}, "Losses"), smoothing()), hint(), curves);
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

/** The largest weight of earlier epochs in a smoothed curve. */
const MOST_SMOOTH = 0.95;

/** The control by which curves of losses are smoothed. */
function smoothing() {
  const range = element("input", { type: "range", min: 0, max: MOST_SMOOTH, step: 0.05, value: state.smooth });
  const output = element("output", {}, String(state.smooth));
  range.addEventListener("input", () => {
    state.smooth = Number(range.value);
    output.textContent = String(state.smooth);
    remember();
    showLosses();
  });
  return element("label", {}, "Smoothing", range, output);
}

/** The exponential means of points: each mean is the weighted mean of the point and of those before. */
function smoothed(points, weight) {
  let [sum, weights] = [0, 0];
  return points.map((point) => {
    if (typeof point.y !== "number") return point;
    [sum, weights] = [weight * sum + point.y, weight * weights + 1];
    return { ...point, y: sum / weights };
  });
}

/** A chart of a term's losses. The colors distinguish runs, or the splits of a single run. */
function lossContent(runs, { task, term }) {
  const series = runs.flatMap((run, place) => {
    const rows = rowsOf(run.losses).filter((row) => row.task === task && row.term === term);
    return distinct(rows.map((row) => row.split)).flatMap((split) => {
      const points = rows.filter((row) => row.split === split).map((row) => ({ x: row.epoch, y: row.value }));
      const color = COLORS[runs.length === 1 ? Number(split !== "train") : place];
      const name = runs.length === 1 ? split : `${run.name.split("/")[1]} ${split}`;
      const line = { name, color, dash: split === "train" ? "dashed" : undefined, line: true, points: smoothed(points, state.smooth) };
      return state.smooth ? [{ color, entry: name, kind: "dot", alpha: 0.3, behind: true, points }, line] : [line];
    });
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
  const better = Object.assign({}, ...runs.map((run) => run.better));
  const columns = ["task", "modality", "metric", "model"].map((name, index) => ({ name, values: parts.map((part) => part[index]) }));
  columns.push({ name: "direction", values: parts.map(([, , metric]) => betterWords(better[metric])) });
  for (const run of runs) {
    const values = new Map(overall(run).map((row) => [key(row), row.value]));
    columns.push({ name: run.name, values: keys.map((text) => values.get(text) ?? null) });
  }
  if (keys.length === 0) return element("p", {}, "Metrics appear when the run is done.");
  const ahead = runs.some((run) => run.horizons.length);
  return element("details", { open: "" }, element("summary", {}, `Metrics on test episodes${ahead ? ", of the next sample" : ""}`), element("div", { class: "scroll" }, plainTable(columns)));
}

/** The lines of a chart, given the rows of each run: those of all models of a single run, or of several networks. */
function linesOf(runs, rows, point) {
  return rows.flatMap((own, place) => {
    // With several runs there would be too many lines for baselines.
    const models = distinct(own.map((row) => row.model)).filter((model) => runs.length === 1 || !BASELINES.includes(model));
    return models.map((model) => ({
      name: runs.length === 1 ? model : runs[place].name.split("/")[1],
      color: COLORS[runs.length === 1 ? BASELINES.indexOf(model) + 1 : place],
      dash: BASELINES.includes(model) ? "dotted" : undefined,
      line: true,
      kind: "disc",
      behind: BASELINES.includes(model),
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
    const all = (name) => columns.find((one) => one.name === name)?.values;
    // The readings of a claim in a scenario are neighbors.
    const keys = all("claim").map((claim, row) => `${claim} ${all("scenario")[row]}`);
    const firstRow = (row) => keys.indexOf(keys[row]);
    const rows = keys.map((_, row) => row).sort((a, b) => firstRow(a) - firstRow(b) || a - b);
    const of = (name) => rows.map((row) => all(name)[row]);
    const table = [
      { name: "claim", values: of("claim").map((claim) => claim.replaceAll("_", " ")) },
      ...(all("reading") ? [{ name: "reading", values: of("reading") }] : []),
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
