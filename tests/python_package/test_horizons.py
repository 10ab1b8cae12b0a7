"""Rows of further horizons, and of models that got only some inputs, change no answer of other functions."""

import hashlib
import io
import json
import shutil
from pathlib import Path

import polars as pl
import pytest
from conftest import ROOT

import harness
from harness import _harness, recorded
from harness.export.runs import Run, read_runs

EXPERIMENTS = ("recommended", "oracle", "reproduction")


BLANK = "sha256-seal:" + "-" * 64
"""The place of a seal."""


def sealed(data: bytes) -> bytes:
    """Puts the seal of a file in the last place for it."""
    start = data.rfind(BLANK.encode()) + len("sha256-seal:")
    return data[:start] + recorded._digest(data, start) + data[start + 64 :]


def add_further_rows(run: Path) -> None:
    """Adds the rows that a run has, with other values: 5 samples ahead, and of a model that got only the arm."""
    record = json.loads((run / "run.json").read_text())
    for name, value in {"metrics": "value", "predictions": "predicted"}.items():
        if not (run / f"{name}.parquet").exists():
            continue
        rows = pl.read_parquet(run / f"{name}.parquet").with_columns(pl.col(value) + 1000)
        horizon, given = pl.lit(5, pl.Int64).alias("horizon"), pl.lit("arm").alias("given")
        ahead = rows.with_columns(horizon, pl.lit(None, pl.String).alias("given"))
        partly = rows.with_columns(pl.lit(1, pl.Int64).alias("horizon"), given)
        file, buffer = run / f"further_{name}.parquet", io.BytesIO()
        pl.concat([ahead, partly]).write_parquet(buffer, metadata={"harness.seal": BLANK})
        data = sealed(buffer.getvalue())
        file.write_bytes(data)
        entry = {"bytes": len(data), "rows": 2 * len(rows), "sha256": hashlib.sha256(data).hexdigest()}
        record["files"][file.name] = entry
    record["seal"] = BLANK
    (run / "run.json").write_bytes(sealed(json.dumps(record).encode()))


def divide(results: Path, experiment: str) -> None:
    """Gives each published run on the first dataset a folder of its own, and removes the files that all runs share."""
    shared = [path for path in (results / "runs" / experiment).iterdir() if path.is_file()]
    for record in json.loads((results / "runs" / experiment / "records.json").read_text())["records"]:
        run = record["run"]
        if "-data" in run:
            continue
        _harness.extract(f"{experiment}/{run}", results / "runs" / experiment / run, results)
    for path in shared:
        path.unlink()


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Published runs as they are, and with further rows."""
    plain, further = (tmp_path_factory.mktemp(name) for name in ("plain", "further"))
    for folder in (plain, further):
        for experiment in EXPERIMENTS:
            shutil.copytree(ROOT / "results/reference/runs" / experiment, folder / "runs" / experiment)
            divide(folder, experiment)
    for record in further.glob("runs/*/*/run.json"):
        add_further_rows(record.parent)
    return plain, further


def test_further_rows_change_no_answer(folders: tuple[Path, Path], tmp_path: Path) -> None:
    plain, further = folders
    both = "select count(*) as n from all_metrics"
    assert harness.query(both, further).item() == 3 * harness.query(both, plain).item()

    def same(ask):
        expected, found = ask(plain), ask(further)
        assert len(expected) > 0 and expected.equals(found)

    same(lambda results: harness.compare(results=results))
    same(lambda results: harness.compare("recommended", where={"latent": 64}, results=results))
    same(lambda results: harness.claims(file=ROOT / "experiments/claims.yaml", results=results))
    tables = {
        "runs": "run",
        "epochs": "run, task, epoch, split, term",
        "metrics": "run, task, model, modality, metric, index, direction",
        "predictions": "run, task, modality, episode, sample, index",
    }
    for table, order in tables.items():
        same(lambda results: harness.query(f"select * from {table} order by experiment, {order}", results))
    axes = {"x": "latent", "metrics": "r2", "by": "modality", "facet": "scenario", "output": tmp_path / "plot.csv"}
    same(lambda results: pl.read_csv(harness.plot("recommended", results=results, **axes)))
    for name in ("prediction_results", "regression"):
        drawn = [
            harness.figures(name, folder=tmp_path, formats="csv", results=results)[0].read_text()
            for results in folders
        ]
        assert drawn[0] == drawn[1] and drawn[0].count("\n") > 3
    assert [problem for problem in harness.verify(further) if problem.broken] == []


def test_trackers_get_further_rows_under_names_of_their_own(folders: tuple[Path, Path]) -> None:
    def metrics(results: Path) -> list[dict[str, float]]:
        return [Run.metrics(run) for run in read_runs(["recommended"], None, results)]

    for usual, every in zip(*map(metrics, folders), strict=True):
        assert len(usual) > 50 and usual.items() <= every.items()
        ahead = {name: value for name, value in every.items() if name.endswith(".h5")}
        partly = {name: value for name, value in every.items() if name.endswith(".given-arm")}
        assert len(every) == len(usual) + len(ahead) + len(partly)
        for names, end in ((ahead, ".h5"), (partly, ".given-arm")):
            assert {name.removesuffix(end): value - 1000 for name, value in names.items()} == pytest.approx(usual)
        # MLflow stores each metric in a file, so no name may be that of another one's folder.
        assert not any(other.startswith(f"{name}/") for name in every for other in every)
