"""Recomputes every number that the harness gives of a results folder, straight from its files, and compares.

    python reference_numbers.py RESULTS ANSWERS

ANSWERS holds what the commands gave: `commands.json` with their exit codes and outputs, `claims.json` with the claims'
queries, and the files that they wrote. Nothing here is taken from the harness but the files' layout: records are read
with json, tables with polars, claims' queries are asked of DuckDB, intervals come from scipy. Prints each difference
and exits with 1 if there are any.
"""

import collections
import hashlib
import json
import pathlib
import re
import sys

import duckdb
import numpy as np
import polars as pl
from scipy import stats

RESULTS, ANSWERS = map(pathlib.Path, sys.argv[1:])
COMMANDS = json.loads((ANSWERS / "commands.json").read_text())
SEAL = re.compile(rb"sha256-seal:([0-9a-f]{64})")
problems = []


def check(condition, *said):
    if not condition:
        problems.append(" ".join(str(word) for word in said))


def close(a, b, tolerance=1e-9):
    if a is None or b is None or a != a or b != b:
        return (a is None or a != a) == (b is None or b != b)
    return abs(a - b) <= tolerance * max(1.0, abs(a), abs(b))


# --- what is there ---


def record_of(folder):
    """A run's record; None where it isn't whole, or not that of this folder."""
    try:
        raw = (folder / "run.json").read_bytes()
    except FileNotFoundError:
        return None
    found = list(SEAL.finditer(raw))
    if not found:
        return None
    blank = raw[: found[-1].start(1)] + b"-" * 64 + raw[found[-1].end(1) :]
    if hashlib.sha256(blank).hexdigest().encode() != found[-1][1]:
        return None
    record = json.loads(raw)
    return record if (record["experiment"], record["run"]) == (folder.parent.name, folder.name) else None


class Run:
    def __init__(self, folder, record):
        self.folder, self.record, self.spec = folder, record, record["spec"]
        self.experiment, self.seed = record["experiment"], record["spec"]["seed"]
        self.scenario, self.latent = self.spec["scenario"], self.spec["latent"]

    def is_damaged(self, table):
        path = self.folder / f"{table}.parquet"
        return not path.exists() or (
            hashlib.sha256(path.read_bytes()).hexdigest() != self.record["files"][path.name]["sha256"]
        )

    def settings(self, *apart):
        """All that decides the run, but for some settings."""
        spec = {key: value for key, value in self.spec.items() if key not in ("seed", *apart)}
        dataset = self.record["dataset"] if "scenario" not in apart else None
        return json.dumps([spec, dataset], sort_keys=True)


FOLDERS = sorted(path for path in RESULTS.glob("runs/*/*") if path.is_dir())
RECORDED = [Run(folder, record) for folder in FOLDERS if (record := record_of(folder))]
DONE = [run for run in RECORDED if run.record["status"] == "done"]


def counting(runs):
    """The runs on one version of each world: of the datasets with the same settings, that of the latest start."""
    latest = {}

    def place(run):
        return run.scenario, json.dumps({**run.spec["simulation"], "episodes": None}, sort_keys=True)

    for run in sorted(runs, key=lambda run: (run.record["started"], run.record["run"])):
        latest[place(run)] = run.record["dataset"]
    return [run for run in runs if latest[place(run)] == run.record["dataset"]]


COUNTING = counting(DONE)


def table(runs, name):
    # All runs on a dataset have the same forces. Commands read those of one of them.
    intact = [run for run in runs if name != "forces" or not run.is_damaged(name)]
    frames = [pl.read_parquet(run.folder / f"{name}.parquet") for run in intact]
    return pl.concat(frames) if frames else None


def interval(values):
    """Mean, and the ends of Student's 95 % interval."""
    values = np.array(values, dtype=float)
    if len(values) < 2:
        return float(values.mean()), None, None
    low, high = stats.t.interval(0.95, len(values) - 1, values.mean(), stats.sem(values)) if values.std() > 0 else (
        values.mean(),
        values.mean(),
    )
    return float(values.mean()), float(low), float(high)


def is_uniform(runs):
    """Whether runs of one experiment differ in scenario, latent size and seed alone."""
    datasets = collections.defaultdict(set)
    for run in runs:
        datasets[run.scenario].add(run.record["dataset"])
    return len({run.settings("scenario", "latent") for run in runs}) < 2 and all(
        len(names) == 1 for names in datasets.values()
    )


def refused(command, runs, tables):
    """Whether a command must have ended with an error, since it reads a damaged table; and checks that it did."""
    answer = COMMANDS[command]
    damaged = {name for name in tables if any(run.is_damaged(name) for run in runs)}
    if not damaged or (damaged == {"forces"} and answer["code"] == 0):
        return False
    check(answer["code"] != 0 and "is damaged" in answer["stderr"], command, "read a damaged table:", answer)
    return True


def same_rows(name, found, expected):
    """Compares two tables as sets of rows, numbers but for rounding."""
    columns = found.columns
    check(found.height == expected.height, name, "has", found.height, "rows instead of", expected.height)
    if found.height != expected.height:
        return
    keys = [column for column in columns if not expected.schema[column].is_float()]
    found, expected = found.sort(keys, nulls_last=True), expected.select(columns).sort(keys, nulls_last=True)
    for a, b in zip(found.iter_rows(named=True), expected.iter_rows(named=True)):
        same = all(a[key] == b[key] for key in keys) and all(close(a[c], b[c]) for c in columns if c not in keys)
        check(same, name, "has", a, "instead of", b)


# --- query ---


def check_queries():
    status = [
        (run.experiment, run.record["run"], {"running": "interrupted"}.get(run.record["status"], run.record["status"]))
        for run in RECORDED
    ]
    found = pl.read_parquet(ANSWERS / "runs.parquet")
    same_rows("runs", found, pl.DataFrame(status, schema=found.columns, orient="row"))
    if not refused("query_metrics", DONE, ["metrics"]):
        keys = ["experiment", "run", "task", "model", "modality", "direction", "index", "metric", "unit"]
        metrics = table(DONE, "metrics")
        found = pl.read_parquet(ANSWERS / "metrics.parquet")
        expected = metrics.select(keys + ["value"]) if metrics is not None else found.clear()
        same_rows("metrics", found, expected)
    if not refused("query_means", DONE, ["metrics"]):
        found = pl.read_parquet(ANSWERS / "means.parquet")
        metrics = table(DONE, "metrics")
        if metrics is None:
            check(found.height == 0, "means of nothing")
            return
        of_networks = (pl.col("model") == "network") & pl.col("index").is_null()
        wanted = metrics.filter(of_networks & pl.col("value").is_not_null())
        grouped = wanted.group_by("experiment", "scenario", "latent", "variant", "metric")
        expected = grouped.agg(pl.col("value").mean().alias("mean"), pl.len().cast(pl.Int64).alias("n"))
        same_rows("means", found.with_columns(pl.col("n").cast(pl.Int64)), expected)


# --- compare ---


def value_of(run, key):
    """A setting's value as texts have it."""
    if key == "dataset":
        return run.record["dataset"]
    value = run.spec
    for part in key.split("."):
        value = value.get(part, "unset") if isinstance(value, dict) else "unset"
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def check_compare():
    if refused("compare", COUNTING, ["metrics"]):
        return
    answer = COMMANDS["compare"]
    if not COUNTING:
        check(answer["code"] == 2 and "no finished runs" in answer["stderr"], "compare of nothing:", answer)
        return
    check(answer["code"] == 0, "compare failed:", answer)
    whole = table(COUNTING, "metrics").filter(
        pl.col("index").is_null() & pl.col("direction").is_null() & pl.col("value").is_not_null(),
        pl.col("metric").is_in(["smape", "wmape", "r2", "relative_error"]),
    )
    by_run = {(run.experiment, run.record["run"]): run for run in COUNTING}
    groups = collections.defaultdict(dict)
    for row in whole.iter_rows(named=True):
        run = by_run[row["experiment"], row["run"]]
        about = (row["task"], row["modality"], row["metric"], row["model"])
        if row["model"] == "network":
            groups[run.experiment, run.settings(), *about][run.seed] = row["value"]
        else:
            # A baseline has neither seed nor latent size; all its runs say the same.
            groups[run.experiment, run.settings("latent"), *about][0] = row["value"]
    found = pl.read_csv(ANSWERS / "compare.csv", infer_schema_length=None)
    check(found.height == len(groups), "compare has", found.height, "means instead of", len(groups))
    seen = set()
    printed = collections.Counter()
    for row in found.iter_rows(named=True):
        # No value has a comma in it but the lists.
        wanted = [part.split("=", 1) for part in re.split(r", (?=[a-z_.]+=)", row["settings"] or "") if part]
        runs = [
            run
            for run in COUNTING
            if run.experiment == row["experiment"]
            and run.scenario == row["scenario"]
            and (row["latent"] is None or run.latent == row["latent"])
            and run.spec.get("variant", "") == (row["variant"] or "")
            and all(value_of(run, key) == value for key, value in wanted)
        ]
        is_network = row["model"] == "network"
        kinds = {run.settings() if is_network else run.settings("latent") for run in runs}
        check(len(kinds) == 1, "compare puts", len(kinds), "kinds of runs into", row)
        key = (row["experiment"], next(iter(kinds), None), row["task"], row["modality"], row["metric"], row["model"])
        check(key not in seen, "compare has twice", row)
        seen.add(key)
        values = list(groups.get(key, {}).values())
        check(values, "compare has what isn't there:", row)
        if not values:
            continue
        mean, low, high = interval(values)
        same = close(row["mean"], mean) and close(row["low"], low) and close(row["high"], high)
        check(same and row["seeds"] == len(values), "compare:", row, "instead of", len(values), (mean, low, high))
        decimals = {"%": 2, "1": 3}[row["unit"]]
        half = "" if high is None else f" ± {high - mean:.{decimals}f}"
        printed[re.sub(r"^-(0\.0+)\b", r"\1", f"{mean:.{decimals}f}") + half] += 1
    lines = [line for line in answer["stdout"].splitlines()[2:] if line.startswith("|")]
    cells = [cell.strip().strip("*") for line in lines for cell in line.split("|")]
    shown = collections.Counter(cell for cell in cells if re.fullmatch(r"-?[0-9.]+( ± [0-9.]+)?", cell))
    # The last digit may be rounded either way where the next is a five.
    missing, extra = printed - shown, shown - printed
    check(sum(missing.values()) == sum(extra.values()) <= 2, "compare prints", extra, "instead of", missing)


# --- claims ---

AGREES = "undecided: 1 seed, agrees"


def check_claims(quick):
    ending = "-quick" if quick else ""
    command = "claims" + ending
    claims = json.loads((ANSWERS / "claims.json").read_text())
    names = {name for claim in claims for name in claim["experiments"]}
    of = {name: [run for run in COUNTING if run.experiment == name + ending] for name in names}
    usable = [claim for claim in claims if all(is_uniform(of[name]) for name in claim["experiments"])]
    for claim in usable:
        queries = claim["sql"] + (claim["required_sql"] or "")
        tables = [name for name in ("metrics", "epochs", "forces", "predictions", "frames") if name in queries]
        if refused(command, [run for name in claim["experiments"] for run in of[name]], tables):
            return
    check(COMMANDS[command]["code"] == 0, command, "failed:", COMMANDS[command])
    found = pl.read_csv(ANSWERS / f"{command}.csv", infer_schema_length=None)
    rows = {(row["claim"], row["scenario"]): row for row in found.iter_rows(named=True)}
    for claim in claims:
        scenarios = claim["scenarios"] or [None]
        if claim not in usable:
            for scenario in scenarios:
                row = rows[claim["id"], scenario]
                check(row["verdict"] == "undecided: settings differ" and row["mean"] is None, "mixed:", row)
            continue
        runs = [run for name in claim["experiments"] for run in of[name]]
        answer = asked(claim["quick" if quick else "sql"], runs)
        required = asked(claim["required_quick" if quick else "required_sql"], runs)
        for scenario in scenarios:
            row = rows[claim["id"], scenario]
            must = values_of(required, scenario)
            groups = [values_of(answer, one) for one in claim["difference"] or [scenario]]
            value = interval_of(groups)
            for ends, prefix in ((value, ""), (interval_of([must]), "required_")):
                same = all(close(row[prefix + name], end) for name, end in zip(("mean", "low", "high"), ends))
                check(same, command, row, "instead of", groups, ends)
            check(row["values"] == sum(map(len, groups)), command, row, "instead of", groups)
            if value[0] is None:
                check(row["verdict"] == "no data", "no data:", row)
                continue
            each = next((name for name in ("seed", "episode") if name in answer[0]), "dataset")
            expected = verdict(value, claim["condition"], each)
            must = verdict(interval_of([must]), claim["required_condition"])
            if claim["required_sql"] and must not in ("holds", AGREES):
                expected = "not testable"
            check(row["verdict"] == expected, command, row, "instead of", expected)


def values_of(answer, scenario):
    return [row["value"] for row in answer if row.get("scenario") == scenario and row["value"] is not None]


def interval_of(groups):
    """The mean of one group, or the difference of two by Welch's t, with its interval. All are None without values."""
    if not all(groups):
        return None, None, None
    if len(groups) == 1:
        return interval(groups[0])
    mean = np.mean(groups[0]) - np.mean(groups[1])
    if min(map(len, groups)) == 1:
        return mean, None, None
    ends = stats.ttest_ind(*groups, equal_var=False).confidence_interval(0.95)
    return mean, ends.low, ends.high


def verdict(value, condition, each="seed"):
    """Holds, does not hold or undecided; and of a single value whether it satisfies the condition."""
    mean, low, high = value
    if mean is None:
        return "no data"
    word, *_, bound = condition.split()
    ends = (mean,) if low is None else (low, high)
    satisfied = tuple((end > float(bound)) == (word == "above") and end != float(bound) for end in ends)
    if len(satisfied) == 1:
        return f"undecided: 1 {each}, {'agrees' if satisfied[0] else 'disagrees'}"
    return {(True, True): "holds", (False, False): "does not hold"}.get(satisfied, "undecided")


def asked(sql, runs):
    """The rows that DuckDB answers a claim's query with."""
    database = duckdb.connect()
    for name in ("metrics", "epochs", "forces", "runs"):
        if sql and name in sql:
            rows = table_of_runs(runs) if name == "runs" else table(runs, name)
            if rows is None:
                return []
            database.register(name, rows)
    return database.sql(sql).pl().to_dicts() if sql else []


def table_of_runs(runs):
    """The columns of `runs` that claims ask for."""
    rows = [
        {"experiment": run.experiment, "scenario": run.scenario, "latent": run.latent, "seed": run.seed}
        | {"parameters": run.record["parameters"]}
        for run in runs
    ]
    return pl.DataFrame(rows) if rows else None


# --- figures ---

STUDIES = {"single_to_multi", "multi_to_multi"}


def drawn(figure, quick, studies, tables, scenario=None):
    """The runs that a figure shows, by study; None where it must not be drawn, which is checked."""
    ending = "-quick" if quick else ""
    command = f"{figure}{ending}"
    of = {name: [run for run in COUNTING if run.experiment == name + ending] for name in studies}
    answer = COMMANDS[command]
    for name, runs in of.items():
        if not runs:
            check(answer["code"] == 1 and "no finished run" in answer["stderr"], command, "of nothing:", answer)
            return None
        if not is_uniform(runs):
            check(answer["code"] == 1 and "differ in" in answer["stderr"], command, "of a mixture:", answer)
            return None
    if scenario and any(all(run.scenario != scenario for run in runs) for runs in of.values()):
        check(answer["code"] == 1, command, "without its scenario:", answer)
        return None
    if refused(command, [run for runs in of.values() for run in runs], tables):
        return None
    check(answer["code"] == 0, command, "failed:", answer)
    return of if answer["code"] == 0 else None


def check_curves(figure, quick, tables=("metrics",)):
    of = drawn(figure, quick, ["single_to_multi", "multi_to_multi"], tables)
    if of is None:
        return
    metrics = table([run for runs in of.values() for run in runs], "metrics")
    found = pl.read_csv(ANSWERS / f"{figure}{'-quick' if quick else ''}.csv", infer_schema_length=None)
    panels = set(found.select("experiment", "task", "modality", "metric").iter_rows())
    networks = metrics.filter(
        pl.struct("experiment", "task", "modality", "metric").map_elements(
            lambda row: tuple(row.values()) in panels, return_dtype=pl.Boolean
        )
        & pl.col("direction").is_not_null()
        & pl.col("index").is_null()
    )
    cells = networks.filter(pl.col("model") == "network")
    cells = cells.select("experiment", "modality", "metric", "scenario", "direction", "latent")
    shown = found.filter(pl.col("model") == "network").height
    check(shown == cells.unique().height, figure, "shows", shown, "cells instead of", cells.unique().height)
    for row in found.iter_rows(named=True):
        keys = ("experiment", "modality", "metric", "scenario", "direction", "model")
        same = [pl.col(key) == row[key] for key in keys]
        values = networks.filter(*same, *([pl.col("latent") == row["latent"]] if row["latent"] is not None else []))
        values = values["value"].to_list()
        expected = interval(values) if row["latent"] is not None else (values[0], None, None)
        for name, value in zip(("mean", "low", "high"), expected):
            check(close(row[name], value), figure, name, row, "instead of", expected)


def check_regression(quick):
    of = drawn("regression", quick, ["single_to_multi", "multi_to_multi"], ["metrics"], "cluttered")
    if of is None:
        return
    # Points are those of the lowest seed of each cell; only these runs' predictions are read.
    lowest = {}
    for run in (run for runs in of.values() for run in runs if run.scenario == "cluttered"):
        best = lowest.get((run.experiment, run.latent))
        if best is None or run.seed < best.seed:
            lowest[run.experiment, run.latent] = run
    metrics = table([run for runs in of.values() for run in runs], "metrics")
    predictions = {key: pl.read_parquet(run.folder / "predictions.parquet") for key, run in lowest.items()}
    found = pl.read_csv(ANSWERS / f"regression{'-quick' if quick else ''}.csv", infer_schema_length=None)
    r2 = {}
    for row in found.iter_rows(named=True):
        key = (row["experiment"], row["latent"], row["modality"], row["index"])
        if key not in r2:
            values = metrics.filter(
                pl.col("experiment") == row["experiment"],
                pl.col("scenario") == "cluttered",
                pl.col("latent") == row["latent"],
                pl.col("task") == "prediction",
                pl.col("modality") == row["modality"],
                pl.col("model") == "network",
                pl.col("metric") == "r2",
                pl.col("index") == row["index"],
            )
            values = values["value"].drop_nulls().to_list()
            r2[key] = interval(values) if values else (None, None, None)
        same = all(close(row[name], value) for name, value in zip(("r2", "r2_low", "r2_high"), r2[key]))
        check(same, "regression", row, "instead of", r2[key])
        point = predictions[row["experiment"], row["latent"]].filter(
            pl.col("task") == "prediction",
            pl.col("modality") == row["modality"],
            pl.col("index") == row["index"],
            pl.col("episode") == row["episode"],
            pl.col("sample") == row["sample"],
        )
        # Single samples are kept in 32 bits.
        same = point.height == 1 and all(close(row[name], point[name][0], 1e-6) for name in ("reference", "predicted"))
        check(same, "regression", row, "instead of", point)


def check_frames(quick):
    figure = "propriovision_to_vision"
    of = drawn(figure, quick, ["multi_to_multi"], ["metrics"])
    if of is None:
        return
    metrics = table(of["multi_to_multi"], "metrics").filter(
        pl.col("task") == "prediction",
        pl.col("modality") == "frame_difference",
        pl.col("model") == "network",
        pl.col("metric") == "relative_error",
    )
    svg = (ANSWERS / f"{figure}{'-quick' if quick else ''}.svg").read_text()
    shown = re.findall(r'aria-label="error ([0-9.]+)(?: ± ([0-9.]+))?"', svg)
    # The empty scenario comes first.
    cells = sorted(metrics.group_by("scenario", "latent"), key=lambda of: (of[0][0] != "empty", of[0]))
    expected = [interval(rows["value"].to_list()) for _, rows in cells]
    check(len(shown) == len(expected), figure, "shows", shown, "instead of", expected)
    for (mean, half), (expected_mean, _, high) in zip(shown, expected):
        check(abs(float(mean) - expected_mean) <= 0.0050001, figure, mean, "instead of", expected_mean)
        check(bool(half) == (high is not None), figure, half, "instead of", high)
        if half:
            expected_half = high - expected_mean
            check(abs(float(half) - expected_half) <= 0.0050001, figure, half, "instead of", expected_half)


def check_forces(quick):
    # Of the first study whose runs can be put together.
    studies = ["single_to_multi", "multi_to_multi"]
    runs = {name: [run for run in COUNTING if run.experiment == name + ("-quick" if quick else "")] for name in studies}
    study = next((name for name in studies if runs[name] and is_uniform(runs[name])), studies[0])
    of = drawn("forces_dataset", quick, [study], ["forces"])
    if of is None:
        return
    forces = table(of[study], "forces").filter(
        (pl.col("modality") == "contact_force") & pl.col("episode").is_null()
    )
    found = pl.read_csv(ANSWERS / f"forces_dataset{'-quick' if quick else ''}.csv", infer_schema_length=None)
    check(found.height == 20 * len({run.scenario for run in of[study]}), "forces of", found.height)
    for row in found.iter_rows(named=True):
        same = forces.filter(pl.col("scenario") == row["scenario"], pl.col("index") == row["link"])
        for name in ("samples", "contacts", "mean", "p05", "p50", "p95", "max"):
            check(all(close(row[name], value) for value in same[name]), "forces", name, row)
        check(close(row["contact_percent"], 100 * same["contacts"][0] / same["samples"][0]), "forces", row)


check_queries()
check_compare()
for quick in [False] + [True] * ("claims-quick" in COMMANDS):
    check_claims(quick)
    check_curves("prediction_results", quick)
    check_curves("reconstruction_performance", quick)
    check_regression(quick)
    check_frames(quick)
    check_forces(quick)
print("\n".join(problems[:40]))
print(f"{len(DONE)} runs done of {len(FOLDERS)} folders, {len(problems)} differences")
sys.exit(1 if problems else 0)
