"""An experiment on a Slurm cluster whose tasks are killed in every way ends with the results of an undisturbed one."""

import csv
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import conftest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "debug/harness"
SPEC = ["experiments/smoke.yaml", f"seeds={list(range(20))}", "tasks=[prediction]"]
SPEC += ["training.epochs=250", "training.patience=null"]
RUNS = 40
TASKS = 8


def harness(cluster, results: Path, *arguments: str) -> str:
    command = [PROGRAM, "--results", results, *arguments]
    answer = subprocess.run(command, cwd=ROOT, env=cluster.environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    return answer.stdout


def metrics(cluster, results: Path) -> list[list[str]]:
    """The metrics of all runs, as texts: equal to the last digit."""
    output = results / "metrics.csv"
    order = "run, task, model, modality, metric, index, direction"
    harness(cluster, results, "query", f"select * from metrics order by {order}", "--output", str(output))
    with output.open() as file:
        return list(csv.reader(file))


def logs(results: Path, step: str) -> dict[int, str]:
    [folder] = (results / "jobs").iterdir()
    found = {}
    for log in folder.glob(f"{step}-*.log"):
        found[int(log.stem.rpartition("-")[2])] = log.read_text(errors="replace")
    return found


def job(cluster, step: str) -> str:
    """The number of a step's job."""
    lines = cluster("squeue", "--noheader", "--format=%F %j").splitlines()
    numbers = {number for number, name in (line.split() for line in lines) if name.endswith(step)}
    assert len(numbers) == 1, lines
    return numbers.pop()


def running(cluster, step: str) -> dict[int, str]:
    """The tasks of a step that run, with their nodes."""
    lines = cluster("squeue", "--noheader", "--array", "--states=RUNNING", "--format=%K %N %j").splitlines()
    tasks = (line.split() for line in lines)
    return {int(index): node for index, node, name in tasks if name.endswith(step)}


def processes(text: str) -> list[int]:
    """Processes of the harness whose command line contains `text`."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
        except OSError:
            continue
        if command.startswith(str(PROGRAM)) and text in command:
            found.append(int(folder.name))
    return found


def kill_when_training(cluster, results: Path, avoid: set[int]) -> int:
    """Waits for a task that trains, and is none of `avoid`; returns its index."""
    end = time.monotonic() + 300
    while True:
        assert time.monotonic() < end, "no other task trains"
        said = logs(results, "train")
        for index in running(cluster, "train"):
            if index not in avoid and processes(f"--shard {index}/{TASKS}") and "epochs" in said.get(index, ""):
                return index
        time.sleep(0.1)


def test_an_experiment_of_killed_tasks_ends_complete_and_equal(cluster, tmp_path):
    undisturbed, results = tmp_path / "undisturbed", tmp_path / "results with 5 %"
    harness(cluster, undisturbed, "run", *SPEC, "--jobs", "2")

    resources = ["--tasks", str(TASKS), "--cpus", "1", "--time", "00:05:00"]
    said = harness(cluster, results, "submit", *SPEC, *resources)
    assert said.startswith(f"{RUNS} runs of smoke submitted: "), said
    conftest.wait_for(lambda: running(cluster, "train"), "training task", 300)
    number = job(cluster, "train")
    disturbed: set[int] = set()

    # A harness that is killed, as by a lack of memory: its task is queued again.
    index = kill_when_training(cluster, results, disturbed)
    [process] = processes(f"--shard {index}/{TASKS}")
    os.kill(process, signal.SIGKILL)
    disturbed.add(index)
    conftest.wait_for(lambda: "ends with code 137" in logs(results, "train")[index], "end of the killed task")

    # The signal of the time limit: the state is saved, and the task is queued again.
    limited = kill_when_training(cluster, results, disturbed)
    cluster("scancel", "--batch", "--signal=TERM", f"{number}_{limited}")
    disturbed.add(limited)
    conftest.wait_for(lambda: "ends with code 143" in logs(results, "train")[limited], "end of the limited task")

    # A task that is cancelled stays so: the last job does its runs.
    cancelled = kill_when_training(cluster, results, disturbed)
    cluster("scancel", f"{number}_{cancelled}")
    disturbed.add(cancelled)

    # A node that goes down with everything on it.
    lost = kill_when_training(cluster, results, disturbed)
    node = running(cluster, "train")[lost]
    for process in processes(f"--shard {lost}/{TASKS}"):
        os.kill(process, signal.SIGKILL)
    cluster("scontrol", "update", f"nodename={node}", "state=down", "reason=test")
    disturbed.add(lost)

    jobs = harness(cluster, results, "ls", "--jobs")
    assert "running" in jobs and "train" in jobs, jobs
    conftest.wait_for(lambda: not cluster("squeue", "--noheader").strip(), "end of all jobs", 900)

    assert metrics(cluster, results) == metrics(cluster, undisturbed)
    assert "all files are intact" in harness(cluster, results, "verify")
    said = "".join(logs(results, "train").values())
    said += next((results / "jobs").glob("*/finish.log")).read_text(errors="replace")
    # Each training says that it is over, and how many of its epochs another process trained before.
    over = re.findall(r"(\S+) prediction: \d+ epochs(, \d+ of them before,)? in ", said)
    assert len({run for run, _ in over}) == RUNS, sorted(over)
    whole = [run for run, before in over if not before]
    assert len(whole) == len(set(whole)), sorted(whole)
    assert re.search(r"task \d begins on \S+, start 2", said), "no task was queued again"
