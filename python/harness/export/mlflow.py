"""Writes runs to MLflow with its own client."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from harness import Exported
from harness.export import bar
from harness.export.runs import Run, by_experiment, params, varying

try:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param, ViewType
    from mlflow.exceptions import MlflowException
except ImportError as error:
    raise ImportError(
        f"exporting to MLflow needs the package mlflow-skinny or mlflow: pip install mlflow-skinny ({error})"
    ) from error

STATUS = {"done": "FINISHED", "failed": "FAILED", "interrupted": "KILLED", "running": "RUNNING"}
"""MLflow's names of the statuses."""

COMPLETE = "harness.version"
"""The tag that is written last. It says which version of the run was exported."""

MOST_PARAMS, MOST_METRICS, MOST_RUNS = 100, 1000, 1000
"""How many MLflow takes or returns in one request."""

Item = TypeVar("Item")


def write(runs: list[Run], tracking_uri: str | None, artifacts: bool, progress: bool) -> Exported:
    """Writes runs to the experiments of their names. Runs that were written before are skipped unless they changed.

    Raises:
        RuntimeError: MLflow refuses it, with its message in one line.
    """
    try:
        client = MlflowClient(tracking_uri)
        exported = 0
        with bar(len(runs), "mlflow", " runs", progress) as shown:
            for name, group in by_experiment(runs).items():
                experiment = _experiment(client, name)
                known, differing = _known(client, experiment), ", ".join(varying(group))
                for run in group:
                    before = known.get(run.name, [])
                    if all(other.data.tags.get(COMPLETE) != run.version for other in before):
                        for other in before:
                            client.delete_run(other.info.run_id)
                        _log(client, experiment, run, differing, artifacts)
                        exported += 1
                    shown.update()
    except MlflowException as error:
        raise RuntimeError(f"MLflow refused it: {' '.join(str(error).split())}") from error
    return Exported(exported, len(runs) - exported)


def _experiment(client: MlflowClient, name: str) -> str:
    """The id of an experiment, which is created if there is none."""
    known = client.get_experiment_by_name(name)
    return str(known.experiment_id if known else client.create_experiment(name))


def _known(client: MlflowClient, experiment: str) -> dict[str, list[Any]]:
    """The runs that were exported to an experiment, by their names here. Runs of an interrupted export are included."""
    known: dict[str, list[Any]] = {}
    token = None
    while True:
        page = client.search_runs(
            [experiment], run_view_type=ViewType.ACTIVE_ONLY, max_results=MOST_RUNS, page_token=token
        )
        for run in page:
            if name := run.data.tags.get("harness.run"):
                known.setdefault(name, []).append(run)
        if not (token := page.token):
            return known


def _log(client: MlflowClient, experiment: str, run: Run, differing: str, artifacts: bool) -> None:
    tags = {f"harness.{name}": value for name, value in run.tags.items()} | {"harness.varies": differing}
    tags["mlflow.source.name"] = run.row["command"]
    if run.row["git_commit"]:
        tags["mlflow.source.git.commit"] = run.row["git_commit"]
    begin, end = int(run.started * 1000), int(run.ended * 1000)
    id = client.create_run(experiment, start_time=begin, tags=tags, run_name=run.id).info.run_id
    settings = [Param(key, value) for key, value in params(run).items()]
    for part in _batches(settings, MOST_PARAMS):
        client.log_batch(id, params=part)
    points = run.curves
    last = max((point.epoch for point in points), default=0)
    metrics = [Metric(point.name, point.value, int(point.time * 1000), point.epoch) for point in points]
    metrics += [Metric(name, value, end, last) for name, value in run.metrics().items()]
    for part in _batches(metrics, MOST_METRICS):
        client.log_batch(id, metrics=part)
    if artifacts:
        with run.files() as files:
            for file in files:
                client.log_artifact(id, str(file))
    client.set_terminated(id, STATUS[run.row["status"]], end)
    client.set_tag(id, COMPLETE, run.version)


def _batches(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    for first in range(0, len(items), size):
        yield items[first : first + size]
