"""Every command over every kind of result: each works, or ends with one message that says what is missing.

Commands that a message suggests are run as well.
"""

import json
import re
import shlex
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from conftest import ROOT, SMOKE

PROGRAM = Path(sys.executable).with_name("harness")

SMALL = ["training.epochs=2", "tasks=[prediction]", "scenarios=[empty]"]
VECTORS = ["input=[proprioception]", "output=[proprioception,contact_force]"]
AHEAD = ["window.horizon=5", "window.context=2"]
FAILING = ["training.learning_rate=1", "training.kl_weight=1000000", "training.epochs=200"]


@dataclass
class Place:
    """A folder in which commands are called, with the results in `results`."""

    folder: Path

    def call(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([PROGRAM, *arguments], cwd=self.folder, capture_output=True, text=True, timeout=300)

    def succeed(self, *arguments: str) -> str:
        answer = self.call(*arguments)
        assert answer.returncode == 0, f"{arguments}: {answer.stdout}{answer.stderr}"
        return answer.stdout

    def runs(self, experiment: str) -> list[str]:
        found = json.loads(self.succeed("ls", experiment, "--format", "json"))
        return [f"{experiment}/{run['run']}" if "/" not in run["run"] else run["run"] for run in found]


def simulated(place: Place) -> str:
    place.succeed("run", str(SMOKE), *SMALL[:1])
    return "smoke"


def imported(place: Place) -> str:
    """Two joints follow a command, and touch something beyond 0.3 rad."""
    (place.folder / "trials").mkdir()
    for trial in range(6):
        generator = np.random.default_rng(trial)
        command = np.repeat(generator.uniform(-1, 1, 8), 10)
        angle = np.convolve(command, np.ones(5) / 5)[: len(command)]
        columns = [np.arange(len(command)) / 10, command, 0.7 * angle, 1.2 * angle, np.maximum(0, angle - 0.3)]
        header = "time,command,first,second,force"
        np.savetxt(place.folder / f"trials/{trial}.csv", np.column_stack(columns), "%.6f", ",", header=header, comments="")
    (place.folder / "lab.yaml").write_text(
        "name: lab\nsource: trials\nformat: csv\nsample_rate_hz: 10\nmax_gap_s: 0.3\n"
        "streams:\n  all: {time: time, file: \"*.csv\"}\n"
        "modalities:\n  setpoint: all.command\n  angles: {from: [all.first, all.second], unit: rad}\n"
        "  force: {from: all.force, unit: N}\n"
    )
    place.succeed("import", "lab.yaml")
    (dataset,) = (place.folder / "results/datasets").iterdir()
    (place.folder / "of_lab.yaml").write_text(
        f"name: of_lab\nscenarios: [{dataset.name}]\ninput: [angles]\noutput: [angles, force]\nlatent: [2, 4]\n"
        "network: {preset: single_to_multi, hidden: [8]}\ntraining: {epochs: 2, batch_size: 32}\n"
    )
    place.succeed("run", "of_lab.yaml")
    return "of_lab"


def horizon(place: Place) -> str:
    place.succeed("run", str(SMOKE), *SMALL, *VECTORS, *AHEAD)
    return "smoke"


def external(place: Place) -> str:
    """A network, and a model of another program that predicts the same."""
    horizon(place)
    columns = "episode, sample, horizon, modality, index, predicted as value"
    place.succeed("query", f"select {columns} from all_predictions", "--output", "predicted.csv")
    place.succeed("judge", str(SMOKE), "predicted.csv", *SMALL, *VECTORS, *AHEAD, "--model", "twin")
    return "smoke"


def memory(place: Place) -> str:
    more = ["network.memory=gru", "window.start=rest", "window.context=10", "network.preset=single_to_multi"]
    place.succeed("run", str(SMOKE), *SMALL, *VECTORS, *more)
    return "smoke"


def no_contact(place: Place) -> str:
    """The arm is never low enough for the finger to touch the ground."""
    place.succeed("run", str(SMOKE), *SMALL, *VECTORS, "simulation.lift_range_m=[-0.05,0]")
    return "smoke"


def one_run(place: Place) -> str:
    place.succeed("run", str(SMOKE), *SMALL, *VECTORS)
    return "smoke"


def failed_run(place: Place) -> str:
    answer = place.call("run", str(SMOKE), *SMALL, *VECTORS, *FAILING)
    assert answer.returncode == 1 and "1 failed" in answer.stdout, answer.stdout + answer.stderr
    return "smoke"


def two_versions(place: Place) -> str:
    for ending in ("yaml", "xml"):
        text = (ROOT / f"models/empty.{ending}").read_text().replace("model: empty.xml", "model: own.xml")
        (place.folder / f"own.{ending}").write_text(text)
    spec = SMOKE.read_text().replace("scenarios: [empty, cluttered]", "scenarios: [own.yaml]")
    (place.folder / "smoke.yaml").write_text(spec)
    model = place.folder / "own.xml"
    for version in range(2):
        place.succeed("run", "smoke.yaml", SMALL[0], SMALL[1], *VECTORS)
        text = model.read_text()
        assert 'friction="' in text
        model.write_text(re.sub('friction="[0-9.]+', f'friction="0.{version + 3}1', text))
    return "smoke"


SITUATIONS: list[Callable[[Place], str]] = [
    simulated,
    imported,
    external,
    horizon,
    memory,
    no_contact,
    one_run,
    failed_run,
    two_versions,
]

COMMANDS = {
    "ls": "ls",
    "show": "show {first}",
    "diff": "diff {first} {last}",
    "compare": "compare {experiment}",
    "plot": "plot {experiment} --x latent --metrics rmse --by modality,variant --facet scenario --output plot.svg",
    "figures": "figures --experiment {experiment} --output drawn --format svg",
    "report": "report {experiment} --output report.html",
    "claims": "claims",
    "query": "query 'select model, task, avg(value) as mean from metrics group by all'",
    "publish": "publish {experiment} --output published",
    "export": "export --format onnx {first} network.onnx",
    "verify": "verify",
}

NO_RUN = "has no finished runs"
MISSING = {
    ("external", "export"): "come from another program, so the harness has no network of it",
    ("failed_run", "compare"): NO_RUN,
    ("failed_run", "plot"): NO_RUN,
    ("failed_run", "figures"): NO_RUN,
    ("failed_run", "report"): NO_RUN,
    ("failed_run", "publish"): NO_RUN,
    ("failed_run", "export"): "is failed, not done",
}
"""What a command says if it can't work, by situation and command."""


@pytest.fixture(scope="module", params=SITUATIONS, ids=lambda prepare: prepare.__name__)
def prepared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Place, str]:
    place = Place(tmp_path_factory.mktemp(request.param.__name__))
    return request.param.__name__, place, request.param(place)


def suggested(text: str) -> Iterator[list[str]]:
    """The arguments of the commands in backticks, and of those after `next`. A text may name `harness render` alone."""
    quoted = re.findall(r"`(harness [^`]+)`", text) + re.findall(r"^next +(harness .+)$", text, re.MULTILINE)
    for command in quoted:
        arguments = shlex.split(command)[1:]
        if arguments != ["render"]:
            # Whole experiments of the paper take hours.
            yield [*arguments, *(["--dry-run"] if "run" in arguments[:3] else [])]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_works_or_says_what_is_missing(prepared: tuple[str, Place, str], command: str) -> None:
    situation, place, experiment = prepared
    runs = place.runs(experiment)
    names = {"experiment": experiment, "first": runs[0], "last": runs[-1]}
    answer = place.call(*shlex.split(COMMANDS[command].format(**names)))
    said = answer.stdout + answer.stderr
    assert "panicked" not in said and "Traceback" not in said, said
    missing = MISSING.get((situation, command))
    if missing is None:
        assert answer.returncode == 0, said
    else:
        assert answer.returncode in (1, 2), said
        (message,) = answer.stderr.splitlines()
        assert missing in message, message
    for suggestion in suggested(said):
        place.succeed(*suggestion)


def test_the_page_shows_it(prepared: tuple[str, Place, str]) -> None:
    situation, place, experiment = prepared
    command = [PROGRAM, "serve", "--port", "0"]
    with subprocess.Popen(command, cwd=place.folder, stdout=subprocess.PIPE, text=True) as serving:
        try:
            assert serving.stdout
            address = serving.stdout.readline().split()[0].rstrip("/")
            answers = ["runs", "settings", "claims", "tables"]
            if (situation, "compare") not in MISSING:
                answers.append(f"compare?experiment={quote(experiment)}")
            answers += [f"run?run={quote(run, safe='')}" for run in place.runs(experiment)]
            for path in answers:
                with urllib.request.urlopen(f"{address}/api/{path}", timeout=60) as answer:
                    json.load(answer)
        finally:
            serving.kill()


def test_what_is_published_can_be_read(prepared: tuple[str, Place, str]) -> None:
    situation, place, experiment = prepared
    if (situation, "publish") in MISSING:
        return
    shutil.rmtree(place.folder / "copy", ignore_errors=True)
    place.succeed("publish", experiment, "--output", "copy")
    for command in (["ls"], ["compare", experiment], ["verify"]):
        place.succeed("--results", "copy", *command)
