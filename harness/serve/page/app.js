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

async function ask(path, options) {
  const answer = await fetch(path, options);
  if (answer.status === 304) return null;
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

const say = (text) => (find("state").textContent = text);

// --- Tabs ---

const tabs = [...document.querySelectorAll("[role=tab]")];
const opened = {};
function open(tab) {
  for (const other of tabs) {
    const chosen = other === tab;
    other.setAttribute("aria-selected", String(chosen));
    other.tabIndex = chosen ? 0 : -1;
    find(other.getAttribute("aria-controls")).hidden = !chosen;
  }
  opened[tab.getAttribute("aria-controls")]?.();
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

const state = {
  columns: [], count: 0, version: "", sort: { name: "started", down: true }, group: "", open: new Set(), chosen: new Map(),
  visible: null,
};
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

/** Filters, sorts and groups the rows, and shows them. */
function update() {
  let matches;
  try {
    matches = parseFilter(find("filter").value, state.columns);
    find("filter").setCustomValidity("");
    say(state.problem ?? "");
  } catch (error) {
    say(error.message);
    return;
  }
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
}

/** The rows by group, in the order of the groups' first rows. The rows of closed groups are left out. */
function grouped(rows) {
  const { values } = named(state.group);
  const groups = new Map();
  for (const row of rows) {
    const key = shown(values[row]);
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(row);
  }
  return [...groups].flatMap(([group, rows]) => {
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
  if (first) {
    const isFirst = (column) => FIRST.includes(column.name) || MIDDLE_METRICS.includes(column.metric);
    state.visible = new Set(state.columns.filter(isFirst).map((column) => column.name));
    find("group").append(new Option("nothing", ""));
    for (const name of ["experiment", "scenario", "variant", "latent", "status", "group_hash", "dataset", "host"]) {
      find("group").append(new Option(name === "group_hash" ? "settings without seed" : name, name));
    }
  }
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
  update();
}

find("filter").addEventListener("input", update);
find("group").addEventListener("change", () => {
  state.group = find("group").value;
  update();
});

// --- Chosen runs ---

async function choose(name) {
  if (state.chosen.has(name)) {
    state.chosen.delete(name);
  } else if (state.chosen.size === MOST_CHOSEN) {
    say(`${MOST_CHOSEN} runs are shown at most; click one of them to take it away`);
    return;
  } else {
    state.chosen.set(name, null);
    try {
      state.chosen.set(name, await ask(`/api/run?run=${encodeURIComponent(name)}`));
    } catch (error) {
      state.chosen.delete(name);
      say(error.message);
    }
  }
  table.draw(true);
  showChosen();
}

const column = (columns, name) => columns.find((one) => one.name === name).values;
const rowsOf = (columns) => column(columns, columns[0].name).map((_, row) => Object.fromEntries(columns.map(({ name, values }) => [name, values[row]])));
const distinct = (values) => [...new Set(values)];

let charts = [];
function showChosen() {
  charts.forEach((chart) => chart.chart.remove());
  charts = [];
  const runs = [...state.chosen.values()].filter((run) => run);
  const place = find("chosen");
  if (runs.length === 0) return place.replaceChildren();
  const parts = element("div");
  place.replaceChildren(parts);
  parts.append(element("h2", {}, runs.length === 1 ? runs[0].name : `${runs.length} runs`));
  for (const run of runs.filter((run) => run.reason)) parts.append(element("p", { class: "problem" }, `${run.name}: ${run.reason}`));
  const curves = element("div", { class: "charts" });
  parts.append(element("h3", {}, "Losses"), curves);
  const losses = runs.flatMap((run) => rowsOf(run.losses));
  for (const task of distinct(losses.map((row) => row.task))) {
    for (const term of distinct(losses.filter((row) => row.task === task).map((row) => row.term))) {
      charts.push({ task, term, chart: new Chart(curves, lossContent(runs, task, term)) });
    }
  }
  if (losses.length === 0) curves.append(element("p", {}, "No epoch has finished yet."));
  parts.append(differences(runs), metricsTable(runs));
  const elements = element("div", { class: "charts" });
  for (const content of elementContents(runs)) charts.push({ chart: new Chart(elements, content) });
  if (elements.childElementCount) parts.append(element("h3", {}, "Joints and links"), elements);
  parts.append(...runs.map(pictures));
  return undefined;
}

function lossContent(runs, task, term) {
  const own = runs.map((run) => ({ run, rows: rowsOf(run.losses).filter((row) => row.task === task && row.term === term) }));
  const epochs = distinct(own.flatMap(({ rows }) => rows.map((row) => row.epoch))).sort((a, b) => a - b);
  const series = own.flatMap(({ run, rows }, color) => distinct(rows.map((row) => row.split)).map((split) => {
    const byEpoch = new Map(rows.filter((row) => row.split === split).map((row) => [row.epoch, row.value]));
    const name = runs.length === 1 ? split : `${run.name.split("/")[1]} ${split}`;
    const values = epochs.map((epoch) => (typeof byEpoch.get(epoch) === "number" ? byEpoch.get(epoch) : null));
    return { name, color: runs.length === 1 ? (split === "train" ? 0 : 1) : color, dashed: split === "train", values };
  }));
  return { title: `${task}: ${term}`, x: { label: "epoch", values: epochs }, y: { label: "loss", logarithmic: true }, series };
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

/** A chart over joints or links for each metric of a predicted vector. */
function elementContents(runs) {
  const rows = runs.map((run) => rowsOf(run.metrics).filter((row) => row.index !== null && row.task === "prediction"));
  const kinds = distinct(rows.flat().map((row) => `${row.modality} ${row.metric}`));
  return kinds.map((kind) => {
    const [modality, metric] = kind.split(" ");
    const own = rows.map((rows) => rows.filter((row) => row.modality === modality && row.metric === metric));
    const places = distinct(own.flat().map((row) => row.index)).sort((a, b) => a - b);
    const series = own.flatMap((rows, color) => distinct(rows.map((row) => row.model)).map((model) => {
      const values = new Map(rows.filter((row) => row.model === model).map((row) => [row.index, row.value]));
      const name = runs.length === 1 ? model : `${runs[color].name.split("/")[1]} ${model}`;
      const at = (place) => (typeof values.get(place) === "number" ? values.get(place) : null);
      return { name, color: runs.length === 1 ? ["network", "persistence", "training_mean", "ridge"].indexOf(model) : color, dashed: model !== "network", points: true, values: places.map(at) };
    }));
    // Baselines are shown for a single run only: with several runs there would be too many lines.
    const shownSeries = runs.length === 1 ? series : series.filter((one) => one.name.endsWith(" network"));
    return { title: `${modality}: ${metric}`, x: { label: "joint or link", values: places }, y: { label: metric }, series: shownSeries };
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

/** Asks for the losses of the chosen runs that train, and lets their curves grow. */
async function follow() {
  for (const [name, run] of state.chosen) {
    if (!run || !["running", "interrupted"].includes(run.status)) continue;
    const now = await ask(`/api/losses?run=${encodeURIComponent(name)}`);
    if (now.status !== run.status) {
      state.chosen.set(name, await ask(`/api/run?run=${encodeURIComponent(name)}`));
      showChosen();
    } else if (JSON.stringify(now.losses) !== JSON.stringify(run.losses)) {
      const known = charts.length;
      run.losses = now.losses;
      const runs = [...state.chosen.values()].filter((run) => run);
      if (known === 0) showChosen();
      for (const { task, term, chart } of charts.filter(({ task }) => task)) chart.update(lossContent(runs, task, term));
    }
  }
}

// --- Claims ---

opened.claims = async () => {
  const place = find("claims");
  if (place.childElementCount) return;
  place.replaceChildren(element("p", {}, "Judging the claims…"));
  try {
    const { columns } = await ask("/api/claims");
    const of = (name) => columns.find((one) => one.name === name).values;
    const interval = (mean, row) => {
      const [low, high] = [of("low")[row], of("high")[row]];
      return low === null ? shown(mean) : `${shown(mean)} [${shown(low)}, ${shown(high)}]`;
    };
    const table = [
      { name: "claim", values: of("claim").map((claim) => claim.replaceAll("_", " ")) },
      ...["verdict", "scenario"].map((name) => ({ name, values: of(name) })),
      { name: "mean and 95 % interval", values: of("mean").map(interval) },
      ...["condition", "measured", "paper", "section"].map((name) => ({ name, values: of(name) })),
      { name: "p (Holm)", values: of("p_holm") },
    ];
    const classes = { holds: "verdict-holds", "does not hold": "verdict-fails" };
    const classOf = (column, value) => (column.name === "verdict" ? classes[value] ?? "" : "");
    place.replaceChildren(element("div", { class: "scroll" }, plainTable(table, classOf)));
  } catch (error) {
    place.replaceChildren(element("p", { class: "problem" }, error.message));
  }
};

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

async function query(event) {
  event.preventDefault();
  find("asked").textContent = "…";
  find("asked").className = "";
  try {
    const answer = await ask("/api/sql", { method: "POST", body: find("question").value });
    const rows = answer.columns[0]?.values.length ?? 0;
    const more = rows < answer.count ? `, the first ${rows} are shown` : "";
    find("asked").textContent = `${answer.count} rows in ${shown(answer.seconds)} s${more}`;
    find("answer").replaceChildren(plainTable(answer.columns));
  } catch (error) {
    find("asked").className = "problem";
    find("asked").textContent = error.message;
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
    if (state.problem) {
      delete state.problem;
      say("");
    }
    if (answer) takeRuns(answer);
    await follow();
  } catch (error) {
    state.problem = error instanceof TypeError ? "the server does not answer; start `harness serve` again" : error.message;
    say(state.problem);
  }
  setTimeout(poll, document.hidden ? 5 * POLL : POLL);
}
poll();
}
