"""Reads every Parquet table of a results folder with independent readers, and computes its metrics again.

    read_tables.py RESULTS

prints JSON:

    {"files": [{"path", "rows": {reader: rows}, "columns": [...], "metadata": {key: text}}],
     "metrics": [{"run", "task", "modality", "direction", "index", "metric", "table", "computed"}]}

`table` is the value of the network in metrics.parquet, `computed` the one that scikit-learn and NumPy make of
predictions.parquet; both are null where the metric is not defined. The frames' metrics can't be computed
again, since frames are not in the predictions.
"""

import json
import sys
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq
from sklearn.metrics import mean_absolute_error, r2_score, root_mean_squared_error

FINGER = ("proprioception", "contact_force", "contact_force_mean")
# The kinds of contacts of each world, in the order of their numbers in the tables.
KINDS = {"empty": ["none", "ground"], "cluttered": ["none", "ground", "box"]}
KEY = ["run", "task", "modality", "direction", "index", "metric"]


def describe(path: Path) -> dict:
    """What each reader makes of a file; all of them read it whole."""
    arrow = pq.read_table(path)
    frame = pd.read_parquet(path)
    names = list(frame.columns)
    assert names == arrow.column_names == pl.read_parquet(path).columns
    duck = duckdb.from_parquet(str(path))
    assert duck.columns == names
    # The same cells, whoever reads them.
    for column in frame.select_dtypes("number"):
        np.testing.assert_array_equal(duck.fetchnumpy()[column], frame[column].to_numpy(), err_msg=column)
    metadata = {key.decode(): text.decode() for key, text in pq.read_metadata(path).metadata.items()}
    return {
        "path": str(path),
        "rows": {
            "pyarrow": arrow.num_rows,
            "pandas": len(frame),
            "duckdb": len(duck.fetchall()),
            "polars": pl.read_parquet(path).height,
        },
        "columns": names,
        "metadata": {key: text for key, text in metadata.items() if key.startswith("harness.")},
    }


def scores(reference: np.ndarray, predicted: np.ndarray, modality: str) -> dict[str, float | None]:
    """The metrics of [samples, columns], columns pooled."""
    error, magnitude = np.abs(reference - predicted), np.abs(reference) + np.abs(predicted)
    varying = np.ptp(reference, axis=0) > 0
    found = {
        "rmse": root_mean_squared_error(reference.ravel(), predicted.ravel()),
        "mae": mean_absolute_error(reference.ravel(), predicted.ravel()),
        "r2": r2_score(reference[:, varying], predicted[:, varying], multioutput="variance_weighted")
        if varying.any()
        else None,
    }
    if modality == "proprioception":
        ratio = np.divide(error, magnitude, out=np.zeros_like(error), where=magnitude > 0)
        found["smape"] = 100 * ratio.mean()
    else:
        found["wmape"] = 100 * error.sum() / np.abs(reference).sum() if reference.any() else None
    return found


def scores_by_kind(reference: np.ndarray, predicted: np.ndarray, kinds: np.ndarray, names: list[str]) -> dict:
    """The metrics over the samples and columns of each kind of contact: those where `kinds` has its number."""
    values = {}
    for number, name in enumerate(names):
        is_kind = kinds == number
        error = (predicted - reference)[is_kind]
        found = {"rmse": np.sqrt(np.mean(error**2)), "mae": np.abs(error).mean()} if is_kind.any() else {}
        magnitude = np.abs(reference[is_kind]).sum()
        found["wmape"] = 100 * np.abs(error).sum() / magnitude if magnitude else None
        means = np.array([column[mask].mean() if mask.any() else 0 for column, mask in zip(reference.T, is_kind.T)])
        constant = np.array([mask.any() and np.ptp(column[mask]) == 0 for column, mask in zip(reference.T, is_kind.T)])
        varying = is_kind & ~constant
        deviation = ((reference - means) ** 2)[varying].sum()
        found["r2"] = 1 - ((predicted - reference) ** 2)[varying].sum() / deviation if deviation else None
        # Without a contact, the forces are zero, so only the absolute errors are defined.
        metrics = ("rmse", "mae") if number == 0 else ("rmse", "mae", "wmape", "r2")
        values |= {f"{metric}_{name}": found.get(metric) for metric in metrics}
    return values


def groups(width: int) -> list[tuple[str | None, int | None, list[int]]]:
    """Direction, index and columns of every group of joints or links that has metrics."""
    joints = list(range(width))
    pooled = [(None, None, joints), ("fe", None, joints[0::2]), ("aa", None, joints[1::2])]
    return pooled + [("fe" if joint % 2 == 0 else "aa", joint, [joint]) for joint in joints]


def contact_kinds(dataset: Path) -> pd.DataFrame:
    """The kind of each link's contact, by episode and sample."""
    episodes = pd.concat(map(pd.read_parquet, sorted(dataset.glob("episode_*.parquet"))))
    return episodes.set_index(["episode", "sample"]).filter(like="contact_force_kind_")


def computed(predictions: pd.DataFrame, touched: pd.DataFrame, kinds: list[str]) -> dict[tuple, float | None]:
    """Every metric that the predictions of one run allow, by the columns of `KEY`."""
    values = {}
    for (run, task, modality), rows in predictions.groupby(["run", "task", "modality"]):
        wide = rows.pivot(index=["episode", "sample"], columns="index", values=["reference", "predicted"])
        reference, predicted = (wide[name].to_numpy(float) for name in ("reference", "predicted"))
        for direction, index, columns in groups(reference.shape[1]):
            found = scores(reference[:, columns], predicted[:, columns], modality)
            for metric, value in found.items():
                values[run, task, modality, direction, index, metric] = value
            if modality == "contact_force" and index is None:
                of_rows = touched.loc[wide.index].to_numpy()[:, columns]
                found = scores_by_kind(reference[:, columns], predicted[:, columns], of_rows, kinds)
                for metric, value in found.items():
                    values[run, task, modality, direction, index, metric] = value
    return values


def written(metrics: pd.DataFrame) -> dict[tuple, float | None]:
    """The network's metrics of one run as the table has them, by the columns of `KEY`."""
    rows = metrics[(metrics["model"] == "network") & metrics["modality"].isin(FINGER)]
    rows = rows[[*KEY, "value"]].astype(object)
    rows = rows.where(rows.notna(), None)
    values = {tuple(key): value for *key, value in rows.itertuples(index=False)}
    assert len(values) == len(rows), "a metric is there twice"
    return values


def is_of_contact(metric: str) -> bool:
    """Whether a metric is one of contacts: by its name, or by the phase of a contact at its end."""
    phases = ("_contact", "_onset", "_sustained", "_release", "_free")
    return metric in ("log_r2", "trimmed_r2", "f1", "auc", "crps") or metric.endswith(phases)


def compare(run: Path) -> list[dict]:
    record = json.loads((run / "run.json").read_text())
    dataset = run.parents[2] / "datasets" / record["dataset"]
    kinds = KINDS[record["spec"]["scenario"]]
    ours = computed(pd.read_parquet(run / "predictions.parquet"), contact_kinds(dataset), kinds)
    # tests/metrics.rs compares the metrics of contacts with Python.
    theirs = written(pd.read_parquet(run / "metrics.parquet"))
    theirs = {key: value for key, value in theirs.items() if not is_of_contact(key[-1])}
    assert ours.keys() == theirs.keys(), sorted(map(str, ours.keys() ^ theirs.keys()))
    return [dict(zip(KEY, key)) | {"table": theirs[key], "computed": ours[key]} for key in ours]


def main(results: Path) -> None:
    answer = {
        "files": [describe(path) for path in sorted(results.glob("**/*.parquet"))],
        "metrics": [row for run in sorted(results.glob("runs/*/*")) for row in compare(run)],
    }
    json.dump(answer, sys.stdout, default=lambda number: number.item())


if __name__ == "__main__":
    main(Path(sys.argv[1]))
