"""Every command and every Python example of the documentation is run, page by page, as a reader would."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import pytest
from conftest import ROOT

import harness

PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "models/README.md", ROOT / "results/README.md"])

BLOCK = re.compile(
    r"^(?:<!-- (?P<note>[^\n]+) -->\n)?```(?P<language>[\w{}-]+)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
"""A fenced block, and the comment directly above it."""

FILE, NOT_RUN = "file: ", "not run: "
"""What comments begin with: the block is saved under this name; the block is not run, for this reason."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    note: str


def blocks(page: Path) -> list[Block]:
    """The blocks of a page that are saved or run."""
    found = (Block(block["language"], block["text"], block["note"] or "") for block in BLOCK.finditer(page.read_text()))
    return [
        block
        for block in found
        if block.note.startswith(FILE)
        or (block.language in ("sh", "console", "python") and not block.note.startswith(NOT_RUN))
    ]


def console(block: Block) -> Iterator[tuple[str, str]]:
    """The commands of a block, which begin with `$`, and the output below each."""
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command, output


def script(page: Path, outputs: Path) -> tuple[str, dict[int, str]]:
    """A shell script of a page's commands, whose outputs go to numbered files, and the outputs that the page shows."""
    lines, shown, numbers = ["set -euo pipefail"], {}, count()

    def add(command: str) -> int:
        number = next(numbers)
        lines.append(f"exec >{outputs}/{number} 2>&1\n{command}")
        return number

    for block in blocks(page):
        if block.note.startswith(FILE):
            lines.append(f"cat >{block.note.removeprefix(FILE)} <<'END_OF_FILE'\n{block.text}END_OF_FILE")
        elif block.language == "sh":
            add(block.text)
        elif block.language == "console":
            for command, output in console(block):
                # A page may show an error.
                shown[add(f"{command} || true")] = output
        else:
            lines.append(f"cat >>examples.py <<'END_OF_EXAMPLE'\n{block.text}\nEND_OF_EXAMPLE")
    # The Python blocks of a page are one program.
    add("test ! -e examples.py || python examples.py")
    return "\n".join(lines) + "\n", shown


def matches(expected: str, output: str) -> bool:
    """Whether an output is the one that a page shows, in which `…` stands for any text."""
    pattern = ".*?".join(re.escape(part) for part in expected.strip().split("…"))
    trimmed = "\n".join(line.rstrip() for line in output.strip().splitlines())
    return re.fullmatch(pattern, trimmed, re.DOTALL) is not None


@pytest.fixture(scope="session")
def library(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder as readers of the guides have it: the smoke experiment and the published ones are done."""
    folder = tmp_path_factory.mktemp("library") / "results"
    shutil.copytree(results, folder)
    shutil.copytree(ROOT / "results/reference/runs", folder / "runs", dirs_exist_ok=True)
    shutil.copytree(ROOT / "results/reference", folder / "reference")
    return folder


def visible(page: Path) -> str:
    """The text of an HTML page and the data of its charts, without styles, scripts and pictures."""
    text = re.sub(r"<style>.*?</style>|<script>.*?</script>", "", page.read_text(), flags=re.DOTALL)
    return re.sub(r"<[^>]*>|[\w+/=]{200,}", " ", text)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
def test_commands_of_a_page_work_and_print_what_it_shows(page: Path, library: Path, tmp_path: Path) -> None:
    folder, outputs = tmp_path / "reader", tmp_path / "outputs"
    for created in (folder, outputs):
        created.mkdir()
    for name in ("models", "experiments"):
        (folder / name).symlink_to(ROOT / name)
    # As links, because many pages need it. The program never changes a file in place.
    shutil.copytree(library, folder / "results", copy_function=os.link)
    commands, shown = script(page, outputs)
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "XDG_CACHE_HOME": str(library.parent / "cache"),
    }
    answer = subprocess.run(
        ["bash", "-c", commands], cwd=folder, env=environment, stdin=subprocess.DEVNULL, check=False
    )
    last = max(outputs.iterdir(), key=lambda path: int(path.name))
    assert answer.returncode == 0, f"{page.name} has a command that fails:\n{last.read_text()[-4000:]}"
    if page.stem == "which-sense-matters":
        # The page that readers make of their own robot is not about the paper's.
        assert "finger" not in visible(folder / "rope/report.html").lower()
    for number, output in shown.items():
        printed = (outputs / str(number)).read_text()
        assert matches(output, printed), f"{page.name} shows\n{output}\nbut the command prints\n{printed}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_of_a_page_has_a_language(page: Path) -> None:
    """Commands in other blocks, such as indented ones, would not be run."""
    assert not re.search(r"^(    |```)", BLOCK.sub("", page.read_text()), re.MULTILINE)


def test_the_page_on_metrics_has_every_metric_and_baseline(library: Path) -> None:
    page = (ROOT / "docs/metrics.md").read_text()
    names = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    rows = harness.query("select distinct metric, model from metrics", library)
    metrics = {re.sub(r"^\w+_from_\d+s$", "METRIC_from_Ns", name) for name in rows["metric"]}
    metrics = {re.sub("^relative_error_.+", "relative_error_REGION", name) for name in metrics}
    metrics = {re.sub(r"^pit_\d$", "pit_BIN", name) for name in metrics}
    phase = r"^[a-z]\w+_(contact|onset|sustained|release|free)$"
    metrics = {re.sub(phase, "METRIC_PHASE", name) for name in metrics}
    metrics = {re.sub("^(r2|rmse|mae|wmape)_.+", "METRIC_KIND", name) for name in metrics}
    # A network has a distribution only if latent states are drawn.
    metrics |= {"coverage_50", "coverage_90", "width_50", "width_90", "pit_BIN"}
    metrics |= {"accuracy", "balanced_accuracy", "log_loss", "confusion"}  # only of categories
    metrics |= {"angle"}  # only of unit vectors
    metrics |= {"nearest_neighbors"}  # only of estimates of the present sample
    # The simulator is a model of another program.
    assert names == metrics | set(rows["model"]) - {"network", "simulator"} | {"METRIC_from_Ns", "skill", "skill_horizon"}
