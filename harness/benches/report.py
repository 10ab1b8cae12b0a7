"""The results of the benchmarks: measurements and the machine, as a Markdown table and as Parquet."""

import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import subprocess
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Measurement:
    """The speed of one contender in one comparison."""

    name: str
    contender: str
    value: float
    lowest: float
    highest: float
    unit: str
    rounds: int
    ratio: float
    target: float | None


@dataclass(frozen=True)
class Machine:
    """The machine and the versions of a measurement."""

    date: str
    processor: str
    cores: int
    memory_bytes: int
    system: str
    harness_version: str
    git_commit: str | None
    git_dirty: bool | None
    mujoco_version: str
    torch_version: str
    pybullet_version: str
    duckdb_version: str
    mlflow_version: str
    python_version: str

    @classmethod
    def this(cls, root: Path, harness: Path) -> "Machine":
        version = importlib.metadata.version
        commit = git(root, "rev-parse", "HEAD")
        changes = git(root, "status", "--porcelain", "--untracked-files=no")
        said = subprocess.run([harness, "--version"], capture_output=True, text=True, check=True).stdout
        return cls(
            date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            processor=processor(),
            cores=cores(),
            memory_bytes=os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
            system=system(),
            harness_version=said.split()[-1],
            git_commit=commit,
            git_dirty=None if changes is None else bool(changes),
            mujoco_version=version("mujoco"),
            torch_version=version("torch"),
            pybullet_version=version("pybullet"),
            duckdb_version=version("duckdb"),
            mlflow_version=version("mlflow-skinny"),
            python_version=platform.python_version(),
        )

    def __str__(self) -> str:
        commit = "no commit" if self.git_commit is None else f"commit {self.git_commit[:10]}"
        changed = " with uncommitted changes" if self.git_dirty else ""
        return (
            f"{self.processor}, {self.cores} cores, {self.memory_bytes / 2**30:.0f} GiB, {self.system}; "
            f"harness {self.harness_version} ({commit}{changed}), mujoco {self.mujoco_version}, "
            f"torch {self.torch_version}, pybullet {self.pybullet_version}, duckdb {self.duckdb_version}, "
            f"mlflow {self.mlflow_version}, Python {self.python_version}; {self.date}"
        )


# Name, kind, unit ("1" for a count or a ratio) and meaning, as `harness schema --tables` prints them for other tables.
COLUMNS = (
    ("name", "text", "", "name of the comparison"),
    ("contender", "text", "", "the compared program; each comparison has one row for harness"),
    ("value", "real", "s or 1/s", "median over the rounds: seconds, or samples per second"),
    ("lowest", "real", "s or 1/s", "lowest value of a round"),
    ("highest", "real", "s or 1/s", "highest value of a round"),
    ("unit", "text", "", "unit of value, lowest and highest: s or 1/s"),
    ("rounds", "integer", "1", "number of rounds, in which the contenders took turns"),
    ("ratio", "real", "1", "speed of the harness divided by the speed of the contender"),
    ("target", "real", "1", "smallest ratio that the project aims for; null if there is none"),
    ("date", "text", "", "when the measurements ended, UTC"),
    ("processor", "text", "", "the machine's processor"),
    ("cores", "integer", "1", "processors that the contenders could use"),
    ("memory_bytes", "integer", "B", "the machine's memory"),
    ("system", "text", "", "operating system"),
    ("harness_version", "text", "", "version of the harness"),
    ("git_commit", "text", "", "commit of the source tree; null outside of a repository"),
    ("git_dirty", "flag", "", "whether the source tree had uncommitted changes; null outside of a repository"),
    ("mujoco_version", "text", "", "version of MuJoCo, for the harness, Python and C"),
    ("torch_version", "text", "", "version of PyTorch"),
    ("pybullet_version", "text", "", "version of PyBullet"),
    ("duckdb_version", "text", "", "version of DuckDB; null for measurements from before it was compared"),
    ("mlflow_version", "text", "", "version of MLflow; null for measurements from before it was compared"),
    ("python_version", "text", "", "version of Python"),
)


def git(root: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", root, *arguments], capture_output=True, check=False, text=True)
    except FileNotFoundError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def cores() -> int:
    """Returns the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        return platform.system()


def quantity(value: float, unit: str) -> str:
    """Formats a time in ms, or a rate, with three digits or more."""
    number, word = (value * 1e3, "ms") if unit == "s" else (value, "samples/s")
    return f"{number:#.3g}".rstrip(".") + f" {word}" if number < 100 else f"{number:.0f} {word}"


def markdown(measurements: list[Measurement], machine: Machine) -> str:
    """Returns one table, with the machine below it."""
    rows = [("what", "harness", "beside", "", "harness is faster by", "at least")]
    for name, group in itertools.groupby(measurements, key=lambda measurement: measurement.name):
        ours, *others = group
        for number, other in enumerate(others):
            first = (name, quantity(ours.value, ours.unit)) if number == 0 else ("", "")
            target = "" if other.target is None else f"{other.target:.1f}"
            rows.append(
                (*first, other.contender, quantity(other.value, other.unit), f"{other.ratio:.2f}", target)
            )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths)) + " |" for row in rows]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    rounds = measurements[0].rounds
    return "\n".join([*lines, "", f"Medians of {rounds} alternating rounds. {machine}"])


def write_parquet(path: Path, measurements: list[Measurement], machine: Machine) -> None:
    """Writes one row for each measurement."""
    write_rows(path, [asdict(measurement) | asdict(machine) for measurement in measurements], COLUMNS)


def write_rows(path: Path, rows: list[dict], columns: tuple[tuple[str, str, str, str], ...]) -> None:
    """Writes a table, with units and meanings in the metadata.

    The file is written completely or not at all. Rows with other values in the first column of an existing file are
    kept.
    """
    import pyarrow
    import pyarrow.parquet

    types = {
        "text": pyarrow.string(),
        "real": pyarrow.float64(),
        "integer": pyarrow.int64(),
        "flag": pyarrow.bool_(),
    }
    described = [dict(zip(("name", "kind", "unit", "meaning"), column)) for column in columns]
    fields = [
        pyarrow.field(name, types[kind], metadata={"unit": unit, "meaning": meaning})
        for name, kind, unit, meaning in columns
    ]
    # The harness's own tables use the same key.
    schema = pyarrow.schema(fields, metadata={"harness.columns": json.dumps(described)})
    key = columns[0][0]
    measured = {row[key] for row in rows}
    if path.exists():
        before = pyarrow.parquet.read_table(path).to_pylist()
        rows = [row for row in before if row[key] not in measured] + rows
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".unfinished-", delete=False) as file:
        temporary = Path(file.name)
    try:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
