"""Settings of the documentation site, which `make docs` builds with Sphinx.

The source is the repository, so links between Markdown files are the same on the site and on a code host.
"""

import __future__

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Generic, TypeVar

import numpy.typing
from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.ext.napoleon import GoogleDocstring

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "python")]

import generated

project = "harness"
author = "the harness developers"
version = re.search(r'^version = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.MULTILINE)[1]
release = version

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*.md", "models/README.md", "results/README.md"]
exclude_patterns = [".*", "harness", "python", "results/*/*", "target", "tests"]
suppress_warnings = ["myst.header"]

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4
# Blocks without a language are commands and outputs.
highlight_language = "text"
html_math_renderer = "mathml"

# The button copies commands without prompts and outputs.
copybutton_prompt_text = "$ "

# In docstrings, `name` is a link if it names an object, and code otherwise.
default_role = "py:obj"
autoclass_content = "both"
autodoc_inherit_docstrings = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_mock_imports = ["av", "datasets", "lerobot", "mujoco", "rerun", "safetensors", "torch"]

html_theme = "furo"
html_title = f"harness {version}"
html_copy_source = False
html_show_search_summary = False
html_show_copyright = False
html_show_sphinx = False


class NDArray(Generic[TypeVar("Value")]):
    """The type that signatures show as `NDArray[float64]`. NumPy's own is shown with its whole definition."""


class ArrayLike:
    """The type of what NumPy converts to an array, such as a list. NumPy's own is shown with its whole definition."""


def load_stub() -> None:
    """Makes autodoc read the stub of the compiled module, which has the types and docstrings."""
    path = ROOT / "python/harness/_harness.pyi"
    module = sys.modules["harness._harness"] = ModuleType("harness._harness")
    exec(compile(path.read_text(), path, "exec", flags=__future__.annotations.compiler_flag), module.__dict__)
    # The stub needs no library.
    mujoco = sys.modules["harness._mujoco"] = ModuleType("harness._mujoco")
    mujoco.load = lambda: None


def read_sections(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Formats the sections of a docstring, such as `Args:`. Attributes have none, but may contain colons."""
    if what not in ("attribute", "property"):
        lines[:] = GoogleDocstring(lines, what=what, name=name, obj=obj).lines()


def complete(app: Sphinx, name: str, source: list[str]) -> None:
    """Inserts the generated parts, and adds the links of the start page to the site's navigation."""
    source[0] = generated.insert(source[0])
    if name == root_doc:
        section = r"^## (.+)\n\n(?:.+\n)+\n((?:(?:- |  ).+\n)+)"
        source[0] = re.sub(section, add_to_navigation, source[0], flags=re.MULTILINE)


def add_to_navigation(section: re.Match[str]) -> str:
    """A section of the start page, followed by a table of contents with the pages that it links to."""
    pages = re.findall(r"^- \[(.+?)\]\((.+?)\)", section[2], re.MULTILINE)
    entries = "\n".join(f"{title} <{page}>" for title, page in pages)
    return f"{section[0]}\n```{{toctree}}\n:hidden:\n:caption: {section[1]}\n\n{entries}\n```\n"


def redirect(app: Sphinx, error: Exception | None) -> None:
    """Makes the site's folder open the start page."""
    (Path(app.outdir) / "index.html").write_text(f'<meta http-equiv="refresh" content="0; url={root_doc}.html">\n')


def setup(app: Sphinx) -> None:
    numpy.typing.NDArray, numpy.typing.ArrayLike = NDArray, ArrayLike
    load_stub()
    app.connect("build-finished", redirect)
    app.connect("autodoc-process-docstring", read_sections)
    app.connect("source-read", complete)
    # Browsers show MathML without a script.
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))


def visit_math(translator, node) -> None:
    translator.body.append(tex2mathml(node.astext(), as_block=False))
    raise SkipNode


def visit_math_block(translator, node) -> None:
    translator.body.append(tex2mathml(node.astext(), as_block=True))
    raise SkipNode
