"""What the installed distribution says about itself, and the files about the project that other programs read."""

import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import pytest
from conftest import ROOT

from harness import _harness, _mujoco

DISTRIBUTION = distribution("soft-harness")
VERSION = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]


def test_the_distribution_has_its_own_name_version_and_licence() -> None:
    assert DISTRIBUTION.version == VERSION
    metadata = DISTRIBUTION.metadata
    assert metadata["Name"] == "soft-harness"
    assert metadata["License-Expression"] == "MIT OR Apache-2.0"
    assert sorted(metadata.get_all("License-File")) == ["LICENSE-APACHE", "LICENSE-MIT"]
    assert metadata.get_all("Project-URL") and metadata["Author"] and metadata["Keywords"]
    for licence in metadata.get_all("License-File"):
        text = DISTRIBUTION.read_text(f"licenses/{licence}")
        assert text == (ROOT / licence).read_text()


def test_the_distribution_has_the_command_and_needs_its_mujoco() -> None:
    [command] = DISTRIBUTION.entry_points
    assert (command.group, command.name, command.value) == ("console_scripts", "harness", "harness.__main__:main")
    assert f"mujoco=={_mujoco.VERSION}" in (DISTRIBUTION.requires or [])


def test_without_mujoco_the_import_says_what_to_install(tmp_path: Path) -> None:
    """Both without the package, and with a package whose library has another version."""
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").touch()
    (tmp_path / "mujoco" / "libmujoco.so.3.0.0").touch()
    missing = "import sys; sys.modules['mujoco'] = None; import harness"
    other = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import harness"
    for statement in (missing, other):
        ended = subprocess.run([sys.executable, "-c", statement], cwd=tmp_path, capture_output=True, text=True)
        expected = "ImportError: MuJoCo 3.17.0 is missing; install its Python package: pip install mujoco==3.17.0\n"
        assert ended.stderr.endswith(expected), ended.stderr


def test_the_citation_is_of_this_version() -> None:
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize(
    ("path", "schema"),
    [("CITATION.cff", "vendor.citation-file-format"), (".github/workflows/ci.yml", "vendor.github-workflows")],
)
def test_files_for_other_programs_follow_their_schemas(path: str, schema: str) -> None:
    check = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema, ROOT / path]
    ended = subprocess.run(check, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def accepts(schema: Path, *files: Path) -> bool:
    """Whether a validator that is not ours accepts files."""
    check = [sys.executable, "-m", "check_jsonschema", "--schemafile", schema, *files]
    return subprocess.run(check, capture_output=True).returncode == 0


def test_the_built_in_experiments_follow_the_schema_for_editors(tmp_path: Path) -> None:
    experiments = ROOT / "experiments"
    specs = [path for path in experiments.glob("*.yaml") if path.stem != "claims"]
    assert accepts(experiments / "schema.json", *specs)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("extends: smoke.yaml\nname: wrong\nlatent: [0]\n")
    assert not accepts(experiments / "schema.json", wrong)


@pytest.mark.parametrize("page", ["exchange", "recordings"])
def test_mappings_follow_the_schema_for_editors(page: str, tmp_path: Path) -> None:
    text, file = (ROOT / f"docs/{page}.md").read_text(), tmp_path / "mapping.yaml"
    blocks = re.findall(r"```yaml\n(name: .*?)```", text, re.DOTALL)
    mappings = [block for block in blocks if "\nmodalities:" in block]
    for mapping in mappings:
        file.write_text(mapping)
        assert accepts(ROOT / "experiments/mapping.schema.json", file)
        content = json.loads(_harness.read_mapping(file))
        assert list(content) == re.findall(r"^(\w+):", mapping, re.MULTILINE)
        for wrong in ("formats: csv\n", 'source: "rec"\nmax_gap_s: .inf\n'):
            file.write_text(re.sub("^source: .*\n", wrong, mapping, flags=re.MULTILINE))
            assert not accepts(ROOT / "experiments/mapping.schema.json", file)
            with pytest.raises(ValueError, match=rf"{file}:\d+:\d+: "):
                _harness.read_mapping(file)
    assert mappings
    with pytest.raises(FileNotFoundError, match="nowhere.yaml: there is no such file"):
        _harness.read_mapping(tmp_path / "nowhere.yaml")
