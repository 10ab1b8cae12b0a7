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

/** A request without an answer, or with an error as its answer. */
class Failure extends Error {}

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
  if (!answer.ok) throw new Failure(text);
  return JSON.parse(text);
}

/** The message of a failure. Throws other errors again, because those are errors of this page. */
function messageOf(error) {
  if (error instanceof Failure) return error.message;
  throw error;
}

/** A failure as an element. */
const problem = (error) => element("p", { class: "problem" }, messageOf(error));

/** Says how the server is, on all tabs. */
const say = (text) => (find("state").textContent = text);
/** Says what is wrong with the filter or the choice of runs, on their tab. */
const note = (text) => (find("note").textContent = text);

// --- The state of the page ---

const state = {
  columns: [], count: 0, version: "", sort: { name: "started", down: true }, open: new Set(), chosen: new Map(),
  // How much the curves of losses are smoothed: the weight of the earlier epochs, from 0 to 0.95.
  smooth: 0,
  // The name of the row of a comparison that is drawn.
  drawn: "",
  // The status of each run, and the names of the columns that a reader has shown or hidden.
  statuses: new Map(), toggled: new Set(),
};

/** The words of the address for the fields of the page. */
const FIELDS = { filter: "filter", group: "group", plotted: "plot", over: "over", compared: "compare" };
const tabs = [...document.getElementsByName("tab")];

/** Writes what is filtered, sorted, grouped, plotted, compared and chosen into the address, so that a link shows the same. */
function remember() {
  // Until the runs are there, the address says what to show.
  if (state.version === "") return;
  const { drawn, smooth, sort, chosen } = state;
  const words = new URLSearchParams();
  const tab = tabs.find(({ checked }) => checked).value;
  if (tab !== "runs") words.set("tab", tab);
  const fields = Object.entries(FIELDS).map(([id, key]) => [key, find(id).value]);
  const drawing = ["draw", find("compared").value && drawn];
  for (const [key, value] of [...fields, drawing, ["smooth", smooth]]) if (value) words.set(key, value);
  if (sort.name !== "started" || !sort.down) words.set(sort.down ? "down" : "up", sort.name);
  for (const name of chosen.keys()) words.append("run", name);
  history.replaceState(null, "", `${location.pathname}${`#${words}`.replace(/^#$/, "")}`);
}

/** Takes over what the address says, once the runs are there. */
function recall() {
  const words = new URLSearchParams(location.hash.slice(1));
  for (const [id, key] of Object.entries(FIELDS)) {
    const field = find(id);
    field.value = words.get(key) ?? "";
    // What the address names may not be offered yet.
    if (words.get(key) && field.value === "") {
      (field.querySelector("optgroup") ?? field).append(new Option(words.get(key)));
      field.value = words.get(key);
    }
  }
  state.drawn = words.get("draw") ?? "";
  state.smooth = Math.min(Math.max(Number(words.get("smooth")) || 0, 0), MOST_SMOOTH);
  for (const direction of ["up", "down"]) {
    if (named(words.get(direction))) state.sort = { name: words.get(direction), down: direction === "down" };
  }
  for (const name of words.getAll("run")) if (state.statuses.has(name)) choose(name);
  (tabs.find(({ value }) => value === words.get("tab")) ?? tabs[0]).checked = true;
  open();
}

// --- Tabs ---

/** What is done when a tab is opened. */
const opened = {};

/** Shows the part of the page whose tab is chosen. */
function open() {
  for (const { value, checked } of tabs) {
    find(value).hidden = !checked;
    if (checked) opened[value]?.();
  }
  remember();
}
for (const tab of tabs) tab.addEventListener("change", open);

// --- Runs ---

const named = (name) => state.columns.find((column) => column.name === name);
/** The column or the setting of this name. */
const columnOf = (name) => named(name) ?? settings.columns.find((column) => column.name === name);
/** The column or the setting that is chosen in a field. */
const chosenIn = (id) => columnOf(find(id).value);
const nameOf = (row) => `${named("experiment").values[row]}/${named("run").values[row]}`;

const table = new BigTable(find("table"), {
  sorted(name) {
    state.sort = { name, down: state.sort.name === name ? !state.sort.down : Boolean(named(name).metric) };
    update();
  },
  toggled(row) {
    if (isNumber(row)) choose(nameOf(row));
    else {
      if (!state.open.delete(row.group)) state.open.add(row.group);
      update();
    }
  },
  isChosen: (row) => state.chosen.has(nameOf(row)),
});

/** Filters, sorts and groups the rows, and shows them. */
function update() {
  const matches = parseFilter(find("filter").value, state.columns, note);
  const rows = Array.from({ length: state.count }, (_, row) => row).filter(matches);
  const column = named(state.sort.name);
  const sign = state.sort.down ? -1 : 1;
  if (column) {
    const { values } = column;
    // Missing values stay last in both directions.
    rows.sort((a, b) => (values[a] === null || values[b] === null ? order(values[a], values[b]) : sign * order(values[a], values[b])));
  }
  find("count").textContent = `${rows.length} of ${state.count} runs`;
  table.show(state.columns.filter(isVisible), chosenIn("group") ? grouped(rows) : rows, state.sort);
  showGroups(rows);
  remember();
  compare();
}

/** Whether a column is in the table. */
const isVisible = ({ name, metric }) => (FIRST.includes(name) || MIDDLE_METRICS.includes(metric)) !== state.toggled.has(name);

/** The rows of each value of a column, in the order of the values' first rows. */
const groupsOf = (rows, { values }) => [...Map.groupBy(rows, (row) => shown(values[row]))];

/** The part of a group's width over which the points of its runs are spread. */
const SPREAD = 0.5;
let groupChart;

/** Adds a chart in a frame, under a title if there is one. */
function addChart(place, content, title) {
  const box = element("div", { class: "chart" }, title);
  place.append(box);
  return new Chart(box).show(content);
}

/** Draws the chosen metric over a setting or over the groups: each run, and means with standard deviations. */
function showGroups(rows) {
  const [metric, over, group] = ["plotted", "over", "group"].map(chosenIn);
  if (!metric || !(over ?? group)) {
    groupChart = undefined;
    find("plot").replaceChildren();
    return;
  }
  const measured = rows.filter((row) => isNumber(metric.values[row]));
  const there = over ? measured.filter((row) => over.values[row] !== null) : [];
  const haveNumbers = there.length > 0 && there.every((row) => isNumber(over.values[row]));
  const content = haveNumbers ? numericContent(there, metric, over, group) : categoryContent(measured, metric, over ?? group);
  if (groupChart) groupChart.show(content);
  else groupChart = addChart(find("plot"), content);
}

/** The mean of a metric over runs at a place of a chart, with the standard deviation. */
function meanPoint(rows, metric, x, name) {
  const { mean, deviation } = meanOf(rows.map((row) => metric.values[row]));
  const bounds = deviation === null ? undefined : [mean - deviation, mean + deviation];
  return { x, y: mean, bounds, says: [`${name}: ${meanText({ mean, deviation })}`] };
}

/** A chart of a metric over the values of a column, which are beside each other. */
function categoryContent(rows, metric, column) {
  const groups = groupsOf(rows, column);
  const runs = groups.flatMap(([name, rows], at) => rows.map((row, index) => ({
    x: at + SPREAD * ((index + 0.5) / rows.length - 0.5),
    y: metric.values[row],
    says: [nameOf(row), `${name}: ${shown(metric.values[row])}`],
  })));
  return {
    title: `${metric.name} by ${column.name}`,
    x: axisOfTexts(column.name, groups.map(([text]) => text)),
    y: axisWithoutOutliers(metric.name, [{ points: runs }]),
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
  const [least, most] = extent(rows.map((row) => over.values[row]));
  const isWide = least > 0 && most / least > WIDE;
  const at = isWide ? Math.log10 : (value) => value;
  const groups = group ? groupsOf(rows, group) : [[MEANS, rows]];
  const series = groups.flatMap(([name, rows], place) => {
    const [own, behind] = group ? [place, place] : [0, 1];
    const says = (row) => [nameOf(row), `${over.name} ${shown(over.values[row])}: ${shown(metric.values[row])}`];
    const points = rows.map((row) => ({ x: at(over.values[row]), y: metric.values[row], says: says(row) }));
    const byValue = [...Map.groupBy(rows, (row) => over.values[row])].sort(([a], [b]) => a - b);
    const means = byValue.map(([value, rows]) => meanPoint(rows, metric, at(value), `${over.name} ${shown(value)}`));
    return [
      { name: group ? name : "runs", color: COLORS[behind % COLORS.length], kind: "dot", behind: true, alpha: 0.6, points },
      { name, color: COLORS[own % COLORS.length], kind: "disc", line: true, points: means },
    ];
  });
  const ticks = isWide ? logarithmicTicks(least, most).map((value) => ({ at: at(value), text: shown(value) })) : undefined;
  return {
    title: `${metric.name} over ${over.name}`,
    x: { label: over.name, ...withMargin([at(least), at(most)]), ticks },
    y: axisWithoutOutliers(metric.name, series.filter((one) => one.behind)),
    series,
  };
}

/** The rows by group, in the order of the groups' first rows. The rows of closed groups are left out. */
function grouped(rows) {
  return groupsOf(rows, chosenIn("group")).flatMap(([group, rows]) => {
    const open = state.open.has(group);
    return [{ group, rows, open }, ...(open ? rows : [])];
  });
}

function takeRuns(answer) {
  const isFirstAnswer = state.version === "";
  // The metrics follow the columns that name a run and its status.
  const rank = ({ name, metric }) => (["experiment", "run", "status"].includes(name) ? 0 : metric ? 1 : 2);
  const columns = answer.columns.sort((a, b) => rank(a) - rank(b));
  Object.assign(state, { columns, count: answer.count, version: answer.version });
  const { values: status } = named("status");
  state.statuses = new Map(status.map((status, row) => [nameOf(row), status]));
  alignSettings();
  if (isFirstAnswer) recall();
  // Metrics appear with the first run that has them.
  offer("plotted", columns.filter((column) => column.metric).map((column) => column.name));
  offer("compared", distinct(named("experiment").values.filter((_, row) => status[row] === "done")));
  find("choice").querySelector("div").replaceChildren(...columns.map((column) => {
    const change = () => {
      if (!state.toggled.delete(column.name)) state.toggled.add(column.name);
      update();
    };
    const box = element("input", { type: "checkbox", checked: isVisible(column) ? "" : undefined, change });
    return element("div", {}, element("label", {}, box, ` ${column.name}`));
  }));
  find("folder").textContent = answer.results;
  find("left-out").hidden = answer.left_out.length === 0;
  find("left-out").textContent = answer.left_out.join(" ");
  update();
  if (BY_SETTING.some((id) => find(id).value && !named(find(id).value))) askSettings().then(update);
  const removed = [...state.chosen.keys()].filter((name) => !state.statuses.has(name));
  if (removed.length) takeAway(removed);
}

/** Offers nothing and these names in a field, which keeps its value if it is among them. */
function offer(id, names) {
  const { value } = find(id);
  find(id).replaceChildren(new Option("nothing", ""), ...names.map((name) => new Option(name, name, false, name === value)));
}

// Another experiment has other rows.
find("compared").addEventListener("change", () => (state.drawn = ""));
for (const id of Object.keys(FIELDS)) find(id).addEventListener(id === "filter" ? "input" : "change", update);

// --- Settings ---

/** The selects that offer the settings in which runs differ. */
const BY_SETTING = ["group", "over"];
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
    const { value } = find(id);
    const options = settings.columns.map(({ name }) => new Option(name, name, false, name === value));
    find(id).querySelector("optgroup").replaceChildren(...options);
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

/** Compares the networks of an experiment with each other and with baselines, unless the page shows that already. */
async function compare() {
  const [place, experiment] = [find("comparison"), find("compared").value];
  const own = JSON.stringify([experiment, experiment && state.version]);
  if (comparedLast === own) return;
  comparedLast = own;
  let answer, failure;
  try {
    if (experiment) answer = await ask(`/api/compare?experiment=${encodeURIComponent(experiment)}`);
  } catch (error) {
    failure = problem(error);
  }
  // The user may have chosen another experiment before the server answered.
  if (comparedLast !== own) return;
  place.replaceChildren(failure ?? "");
  if (answer) showComparison(place, experiment, answer);
}

/** What a table of a comparison is of, in words. */
const tableWords = (table) => [table.scenario, table.task, table.settings].filter((word) => word).join(", ");
const rowWords = (table, row) => `${row.modality}, ${row.metric}, ${tableWords(table)}`;

function showComparison(place, experiment, { tables, notes }) {
  const rows = tables.flatMap((table) => table.rows.map((row) => ({ table, row, name: rowWords(table, row) })));
  const content = () => {
    const { table, row } = rows.find(({ name }) => name === state.drawn) ?? rows[0];
    return comparisonContent(table, row);
  };
  const change = () => {
    state.drawn = select.value;
    remember();
    chart.show(content());
  };
  const select = element("select", { change });
  select.append(...rows.map(({ name }) => new Option(name, name, false, name === state.drawn)));
  place.append(element("h2", {}, experiment), ...notes.map((text) => element("p", {}, text)));
  if (rows.length === 0) return;
  place.append(element("div", { class: "controls" }, element("label", {}, "Figure of ", select)));
  const chart = addChart(place, content());
  place.append(...tables.map(comparisonTable));
}

/** A table of networks and baselines, under its title. The best value of each row is bold. */
function comparisonTable(table) {
  const { rows, over } = table;
  const cell = (one) => (one?.is_best ? element("b", {}, one.text) : one?.text);
  const columns = [
    { name: "modality", values: rows.map((row) => row.modality) },
    { name: "metric", values: rows.map((row) => row.metric + betterArrow(row.better)) },
    ...table.columns.map(({ name }, at) => ({ name, kind: "number", values: rows.map((row) => cell(row.cells[at])) })),
  ];
  return element("div", {}, element("h3", {}, tableWords(table)), element("div", { class: "scroll" }, plainTable(columns)),
    element("p", { class: "hint" }, over ? `± is half of the 95 % interval over ${over}.` : "Each value is of one run."));
}

/** The ends of an axis for networks, and for those baselines that are near them. The others are named as beyond it. */
function aroundNetworks(networks, baselines) {
  if (networks.length === 0) return {};
  const [min, max] = extent(networks.flatMap((point) => [point.y, ...(point.bounds ?? [])]));
  const room = max - min || 0.1 * Math.abs(max) || 1;
  const near = baselines.map((point) => point.y).filter((y) => y >= min - room && y <= max + room);
  return withMargin([min, max, ...near], 0.05);
}

/** A chart of a row of a comparison: the mean of each column, with its interval. */
function comparisonContent(table, row) {
  const points = (isBaseline) => row.cells.flatMap((cell, at) => (cell && table.columns[at].is_baseline === isBaseline
    ? [{ x: at, y: cell.mean, bounds: cell.bounds ?? undefined, says: [`${table.columns[at].name}: ${cell.text}`] }] : []));
  const [networks, baselines] = [points(false), points(true)];
  return {
    title: rowWords(table, row),
    x: axisOfTexts("network or baseline", table.columns.map(({ name }) => name)),
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
  if (state.chosen.has(name)) return takeAway([name]);
  if (state.chosen.size === MOST_CHOSEN) return note(`${MOST_CHOSEN} runs are shown at most; click one of them to take it away`);
  state.chosen.set(name, null);
  table.draw(true);
  try {
    const run = await askRun(name);
    if (state.chosen.has(name)) state.chosen.set(name, run);
  } catch (error) {
    note(messageOf(error));
    state.chosen.delete(name);
  }
  return takeAway([]);
}

const askRun = (name) => ask(`/api/run?run=${encodeURIComponent(name)}`);

/** Takes runs from the chosen ones, and shows those that are left. */
function takeAway(names) {
  for (const name of names) state.chosen.delete(name);
  table.draw(true);
  showChosen();
  remember();
}

/** The chosen runs that the server has answered with. */
const chosenRuns = () => [...state.chosen.values()].filter((run) => run);

/** The rows of a table that has a list of values for each column. */
function rowsOf(columns) {
  const row = (_, place) => Object.fromEntries(columns.map(({ name, values }) => [name, values[place]]));
  return (columns[0]?.values ?? []).map(row);
}

/** The rows of a table of several runs, each with the `place` of its run. */
const rowsOfRuns = (runs, table) => runs.flatMap((run, place) => rowsOf(run[table]).map((row) => ({ ...row, place })));

/** The rows in groups that have the same values of some keys, as lists of values and rows. */
function groupsBy(rows, keys) {
  const groups = Map.groupBy(rows, (row) => JSON.stringify(keys.map((key) => row[key])));
  return [...groups].map(([values, rows]) => [JSON.parse(values), rows]);
}

/** The charts of losses that are shown, by their titles. */
let lossCharts = new Map();

/** Adds charts beside each other, under their titles, and what is above them. */
function addCharts(place, above, contents) {
  const grid = element("div", { class: "charts" });
  if (contents.length) place.append(...above, grid);
  return contents.map((content) => [content.title, addChart(grid, content, element("h4", {}, content.title))]);
}

function showChosen() {
  const runs = chosenRuns();
  const place = find("chosen");
  place.replaceChildren();
  lossCharts = new Map();
  if (runs.length === 0) return;
  const title = runs.length === 1 ? runs[0].name : `${runs.length} runs`;
  const reasons = runs.filter((run) => run.reason).map((run) => element("p", { class: "problem" }, `${run.name}: ${run.reason}`));
  place.append(element("h2", {}, title), ...reasons, element("div", { class: "controls" }, element("h3", {}, "Losses"), smoothing()));
  lossCharts = new Map(addCharts(place, [hint()], lossContents(runs)));
  if (lossCharts.size === 0) place.append(element("p", {}, "No epoch has finished yet."));
  place.append(differences(runs), metricsTable(runs));
  addCharts(place, [element("h3", {}, "By element")], elementContents(runs));
  addCharts(place, [element("h3", {}, "Over the horizon")], horizonContents(runs));
  place.append(...runs.map(pictures));
}

/** The largest weight of earlier epochs in a smoothed curve. */
const MOST_SMOOTH = 0.95;

/** The control by which curves of losses are smoothed. */
function smoothing() {
  const input = () => {
    state.smooth = Number(range.value);
    output.textContent = range.value;
    remember();
    showLosses();
  };
  const range = element("input", { type: "range", min: 0, max: MOST_SMOOTH, step: 0.05, value: state.smooth, input });
  const output = element("output", {}, String(state.smooth));
  return element("label", {}, "Smoothing", range, output);
}

/** The exponential means of points: each mean is the weighted mean of the point and of those before. */
function smoothed(points, weight) {
  let [sum, weights] = [0, 0];
  return points.map((point) => {
    if (!isNumber(point.y)) return point;
    [sum, weights] = [weight * sum + point.y, weight * weights + 1];
    return { ...point, y: sum / weights };
  });
}

/** A chart of each term's losses. The colors distinguish runs, or the splits of a single run. */
function lossContents(runs) {
  return groupsBy(rowsOfRuns(runs, "losses"), ["task", "term"]).map(([[task, term], rows]) => {
    const series = groupsBy(rows, ["place", "split"]).flatMap(([[place, split], rows]) => {
      const points = rows.map((row) => ({ x: row.epoch, y: row.value }));
      const color = COLORS[runs.length === 1 ? Number(split !== "train") : place];
      const name = runs.length === 1 ? split : `${shortName(runs[place])} ${split}`;
      const line = { name, color, dash: split === "train" ? "dashed" : undefined, line: true, points: smoothed(points, state.smooth) };
      return state.smooth ? [{ color, entry: name, kind: "dot", alpha: 0.3, behind: true, points }, line] : [line];
    });
    return { title: `${task}: ${term}`, x: EPOCHS, y: { label: "loss", logarithmic: true }, series };
  });
}

/** The name of a run without its experiment. */
const shortName = (run) => run.name.split("/")[1];

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
  // Elements with different units have a value for each unit, whose direction is "in" that unit.
  const isOverall = ({ index, direction }) => index === null && (direction === null || direction.startsWith("in "));
  const overall = rowsOfRuns(runs, "metrics").filter(isOverall);
  const keys = ["task", "modality", "metric", "model", "unit"];
  const groups = groupsBy(overall, keys);
  if (groups.length === 0) return element("p", {}, "Metrics appear when the run is done.");
  const better = Object.assign({}, ...runs.map((run) => run.better));
  const ofRun = (run, place) => ({ name: run.name, values: groups.map(([, rows]) => rows.find((row) => row.place === place)?.value) });
  const columns = [
    ...keys.map((name, at) => ({ name, values: groups.map(([values]) => values[at]) })),
    { name: "direction", values: groups.map(([[, , metric]]) => betterWords(better[metric])) },
    ...runs.map(ofRun),
  ];
  const ahead = runs.some((run) => run.horizons.length) ? ", of the next sample" : "";
  return element("details", { open: "" }, element("summary", {}, `Metrics on test episodes${ahead}`),
    element("div", { class: "scroll" }, plainTable(columns)));
}

/** The lines of a chart: those of all models of a single run, or of several networks. */
function linesOf(runs, rows, point) {
  const isSingle = runs.length === 1;
  // With several runs there would be too many lines for baselines.
  const drawn = rows.filter(({ model }) => isSingle || !BASELINES.includes(model));
  return groupsBy(drawn, ["place", "model"]).map(([[place, model], rows]) => ({
    ...lookOfModel(model, COLORS[isSingle ? BASELINES.indexOf(model) + 1 : place]),
    name: isSingle ? model : shortName(runs[place]),
    points: rows.map(point),
  }));
}

/** A chart over the elements, such as joints or links, for each metric and unit of a predicted vector. */
function elementContents(runs) {
  const ofElements = rowsOfRuns(runs, "metrics").filter((row) => row.index !== null && row.task === "prediction");
  return groupsBy(ofElements, ["modality", "metric", "unit"]).map(([[modality, metric, unit], rows]) => {
    const names = runs.find((run) => run.elements[modality])?.elements[modality] ?? [];
    const indices = distinct(rows.map((row) => row.index));
    const ticks = indices.map((at) => ({ at, text: names[at] ?? String(at) }));
    const series = linesOf(runs, rows, (row) => ({ x: row.index, y: row.value }));
    const x = { label: "element", low: indices[0] - 0.5, high: indices.at(-1) + 0.5, ticks };
    return { title: `${modality}: ${metric}`, x, y: axisWithoutOutliers(withUnit(metric, unit), series), series };
  });
}

/** The metrics over the horizon: the error, and the skill over persistence. */
const OVER_HORIZON = ["r2", "relative_error", "skill"];

/** A chart over the horizon for each modality and metric of runs that predict further than one sample. */
function horizonContents(runs) {
  const rates = distinct(runs.map((run) => run.sample_seconds));
  const ahead = rowsOfRuns(runs, "horizons").filter((row) => OVER_HORIZON.includes(row.metric));
  return groupsBy(ahead, ["modality", "direction", "metric"]).map(([[modality, direction, metric], rows]) => {
    const series = linesOf(runs, rows, (row) => ({ x: horizonPlace(row.horizon), y: row.mean }));
    const x = horizonAxis(distinct(rows.map((row) => row.horizon)), rates.length === 1 ? rates[0] : null);
    const title = `${[modality, direction].filter((part) => part).join(" ")}: ${metric}`;
    return { title, x, y: axisWithoutOutliers(metric, series), series };
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
  const contents = lossContents(chosenRuns());
  if (contents.map(({ title }) => title).join() !== [...lossCharts.keys()].join()) showChosen();
  else for (const content of contents) lossCharts.get(content.title).show(content);
}

/**
 * Asks for what is new of a chosen run that trains or has another status than before, and shows it. The run may be taken away
 * before the server answers.
 */
async function followRun(name, run) {
  const trains = ["running", "interrupted"].includes(run?.status);
  if (!run || (!trains && run.status === state.statuses.get(name))) return;
  const now = await askRun(name);
  if (state.chosen.get(name) !== run) return;
  state.chosen.set(name, now);
  if (now.status !== run.status) showChosen();
  else if (JSON.stringify(now.losses) !== JSON.stringify(run.losses)) showLosses();
}

/** Follows the chosen runs. Throws the first failure at the end. */
async function follow() {
  const all = await Promise.allSettled([...state.chosen].map(([name, run]) => followRun(name, run)));
  const failed = all.find(({ status }) => status === "rejected");
  if (failed) throw failed.reason;
}

// --- Claims ---

/** The version of the runs by which the claims were judged last. */
let judged = "";
let judging = false;

/** Judges the claims if they are visible and the runs have changed since. */
async function judge() {
  if (judging || find("claims").hidden || judged === state.version) return;
  judging = true;
  judged = state.version;
  try {
    await showClaims();
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
    // The readings of a claim in a scenario are neighbors.
    const rows = groupsBy(rowsOf(columns), ["claim", "scenario"]).flatMap(([, rows]) => rows);
    const column = (name, of = (row) => row[name]) => ({ name, values: rows.map(of) });
    const table = [
      column("claim", (row) => row.claim.replaceAll("_", " ")),
      ...(columns.some(({ name }) => name === "reading") ? [column("reading")] : []),
      column("verdict"),
      column("scenario"),
      column("mean and 95 % interval", (row) => interval(row.mean, row.low, row.high)),
      ...["datasets", "condition", "measured", "paper", "section"].map((name) => column(name)),
      column("p (Holm)", (row) => row.p_holm),
    ];
    const classes = { holds: "verdict-holds", "does not hold": "verdict-fails" };
    const classOf = (column, value) => (column.name === "verdict" ? classes[value] ?? "" : "");
    place.replaceChildren(element("div", { class: "scroll" }, plainTable(table, classOf)));
  } catch (error) {
    place.replaceChildren(problem(error));
  }
}

// --- SQL ---

opened.sql = async () => {
  if (find("columns").childElementCount) return;
  const tables = await ask("/api/tables");
  find("columns").replaceChildren(...tables.map((table) => element("details", {},
    element("summary", {}, table.name), element("p", {}, table.meaning),
    element("dl", {}, ...table.columns.flatMap((column) => [
      element("dt", {}, withUnit(column.name, column.unit ?? "")),
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
    say("");
  } catch (error) {
    say(messageOf(error));
  } finally {
    setTimeout(poll, document.hidden ? 5 * POLL : POLL);
  }
}
poll();
}
