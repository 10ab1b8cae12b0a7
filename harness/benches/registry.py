"""Reads the runs of a results folder with MLflow's file store and with DuckDB, for compare.py.

    .venv-bench/bin/python harness/benches/registry.py fill RESULTS STORE      copies the runs to a file store of MLflow
    .venv-bench/bin/python harness/benches/registry.py list RESULTS duckdb
    .venv-bench/bin/python harness/benches/registry.py mean STORE mlflow

`list` finds all runs with their status. `mean` computes the mean of a metric over the seeds of each cell. The reader
`duckdb` reads the files of the runs, and `duckdb-compacted` reads the compacted tables. Both commands print the time in
seconds and the answer as JSON. The start of Python and its imports are not counted. compare.py calls this program. Run
it on an otherwise idle machine.

A run in the file store has the parameters and metrics that a user of MLflow would log: each setting of its spec, and
each metric of the network over all joints, links or pixels. It has no losses of epochs and no artifacts. The tables in
the results folder also have metrics of the baselines and of each joint, losses, predictions, forces and images.
"""

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path

# MLflow recommends a database, and opens no file store without this.
os.environ["MLFLOW_ALLOW_FILE_STORE"] = "true"

EXPERIMENT = "single_to_multi"
# compare.py asks the harness the same about its table `metrics`.
MEAN = f"""select scenario, latent, avg(value) as mean from {{metrics}}
    where experiment = '{EXPERIMENT}' and task = 'prediction' and model = 'network' and modality = 'contact_force'
      and metric = 'r2' and index is null and direction is null
    group by scenario, latent order by scenario, latent"""
LIST = "select experiment, run, status, started from {runs} order by experiment, run"


def settings(spec: dict, prefix: str = "") -> dict[str, str]:
    """The settings of a spec as text, by their dotted names."""
    found = {}
    for key, value in spec.items():
        found |= settings(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: str(value)}
    return found


# MLflow


def fill(results: Path, store: Path) -> None:
    """Copies all runs to a new file store."""
    from mlflow.store.tracking.file_store import FileStore

    rows = duckdb_rows(
        f"""select experiment, run, task, modality, metric, value
            from read_parquet('{results}/runs/*/*/metrics.parquet')
            where model = 'network' and index is null and direction is null and value is not null"""
    )
    metrics: dict[tuple[str, str], dict[str, float]] = {}
    for experiment, run, *name, value in rows:
        metrics.setdefault((experiment, run), {})[".".join(name)] = value
    opened = FileStore(str(store))
    ids = {name: opened.create_experiment(name) for name in sorted({experiment for experiment, _ in metrics})}
    work = [
        (store, ids[experiment], results / "runs" / experiment / run, values)
        for (experiment, run), values in metrics.items()
    ]
    with multiprocessing.Pool() as pool:
        pool.starmap(copy, work, chunksize=64)


def copy(store: Path, experiment: str, folder: Path, metrics: dict[str, float]) -> None:
    """Copies one run."""
    from mlflow.entities import Metric, Param, RunTag
    from mlflow.store.tracking.file_store import FileStore

    record = json.loads((folder / "run.json").read_text())
    parameters = [Param(key, value) for key, value in settings(record["spec"]).items()]
    tags = [RunTag("status", record["status"]), RunTag("started", record["started"])]
    opened = FileStore(str(store))
    run = opened.create_run(experiment, "user", 0, tags, record["run"])
    opened.log_batch(run.info.run_id, [Metric(name, value, 0, 0) for name, value in metrics.items()], parameters, [])


def runs_of(store: Path, experiments: list[str]) -> list:
    """All runs of these experiments, or of all experiments."""
    from mlflow.entities import ViewType
    from mlflow.store.tracking.file_store import FileStore

    opened = FileStore(str(store))
    chosen = [one for one in opened.search_experiments() if one.name in experiments or not experiments]
    ids = [one.experiment_id for one in chosen]
    runs = opened.search_runs(ids, "", ViewType.ACTIVE_ONLY, max_results=50_000)
    if runs.token:
        raise SystemExit("the file store has more than 50,000 runs")
    return runs


def list_mlflow(store: Path) -> list:
    runs = runs_of(store, [])
    return sorted([run.info.run_name, run.data.tags["status"], run.data.tags["started"]] for run in runs)


def mean_mlflow(store: Path) -> list:
    cells: dict[tuple[str, int], list[float]] = {}
    for run in runs_of(store, [EXPERIMENT]):
        cell = (run.data.params["scenario"], int(run.data.params["latent"]))
        cells.setdefault(cell, []).append(run.data.metrics["prediction.contact_force.r2"])
    return [[*cell, sum(values) / len(values)] for cell, values in sorted(cells.items())]


# DuckDB


def duckdb_rows(sql: str) -> list:
    import duckdb

    return [list(row) for row in duckdb.sql(sql).fetchall()]


def list_duckdb(results: Path) -> list:
    # Without their types, DuckDB infers those of all columns, which takes more than 18 GB for 10,000 records.
    types = "{experiment: 'VARCHAR', run: 'VARCHAR', status: 'VARCHAR', started: 'VARCHAR'}"
    return duckdb_rows(LIST.format(runs=f"read_json('{results}/runs/*/*/run.json', columns = {types})"))


def mean_duckdb(results: Path) -> list:
    return duckdb_rows(MEAN.format(metrics=f"read_parquet('{results}/runs/*/*/metrics.parquet')"))


def mean_compacted(results: Path) -> list:
    return duckdb_rows(MEAN.format(metrics=f"read_parquet('{results}/compacted/*/metrics-*.parquet')"))


READERS = {
    ("list", "mlflow"): list_mlflow,
    ("mean", "mlflow"): mean_mlflow,
    ("list", "duckdb"): list_duckdb,
    ("mean", "duckdb"): mean_duckdb,
    ("mean", "duckdb-compacted"): mean_compacted,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("fill", "list", "mean"))
    parser.add_argument("folder", type=Path, help="results folder or file store")
    parser.add_argument("other", help="the new file store, or the reader: mlflow, duckdb or duckdb-compacted")
    options = parser.parse_args()
    if options.command == "fill":
        fill(options.folder, Path(options.other))
        return
    read = READERS.get((options.command, options.other))
    if read is None:
        parser.error(f"'{options.other}' can't {options.command}")
    if options.other == "mlflow":
        import mlflow.store.tracking.file_store  # noqa: F401
    else:
        import duckdb  # noqa: F401
    begin = time.perf_counter()
    answer = read(options.folder)
    print(json.dumps({"seconds": time.perf_counter() - begin, "answer": answer}))


if __name__ == "__main__":
    main()
