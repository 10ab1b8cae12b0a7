"""The parts of the reference that the program itself prints, as Markdown.

When the site is built, the part with this name replaces everything from a comment `<!-- generated: NAME -->` to the
comment `<!-- end -->`. The text between them is for readers of the plain Markdown.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = Path(sys.executable).with_name("harness")

Schema = dict[str, Any]

LARGEST_INTEGER = 2**53 - 1
"""The largest integer that JSON numbers represent exactly. It is not shown as a bound."""


def harness(*arguments: str) -> str:
    """Returns what the program prints, 80 columns wide."""
    environment = os.environ | {"COLUMNS": "80"}
    return subprocess.run(
        [PROGRAM, *arguments], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


def command_line() -> str:
    """The help of every command."""
    return "\n".join(f"## {' '.join(words)}\n\n```text\n{help.rstrip()}\n```\n" for words, help in helps(["harness"]))


def helps(words: list[str]) -> Iterator[tuple[list[str], str]]:
    """The help of a command and of the commands below it."""
    text = harness(*words[1:], "--help")
    yield words, text
    listed = re.search(r"^Commands:\n((?:  .*\n)+)", text, re.MULTILINE)
    names = re.findall(r"^  (\w+)", listed[1], re.MULTILINE) if listed else []
    if words == ["harness"]:
        # The commands that are written in Python are not part of the program's own list.
        names += [name for name in ("export", "import") if name not in names]
    for name in names:
        if name != "help":
            yield from helps([*words, name])


def tables() -> str:
    """The columns of every table."""
    names = {table["table"]: table["meaning"] for table in answer("show tables")}
    columns = {name: answer(f"describe {name}") for name in names}
    of_runs = [columns[name] for name in names if name != "episodes"]
    shared = [column for column in of_runs[0] if all(column in others for others in of_runs)]
    parts = [f"## Columns of all tables but episodes\n\n{column_list(shared)}"]
    for name, meaning in names.items():
        own = [column for column in columns[name] if name == "episodes" or column not in shared]
        parts.append(f"## {name}\n\n{sentence(meaning)}\n\n{column_list(own)}")
    return "\n".join(parts)


def answer(sql: str) -> list[dict[str, str]]:
    """The rows of a query's answer."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "answer.json"
        harness("query", sql, "--results", "results/reference", "--output", str(file))
        return json.loads(file.read_text())


def column_list(columns: list[dict[str, str]]) -> str:
    """A definition list of columns. The elements of a vector share an item."""
    items = []
    for _, group in groupby(columns, lambda column: (re.sub(r"_\d+$", "", column["column"]), column["unit"])):
        elements = list(group)
        first, last = elements[0], elements[-1]
        name = f"`{first['column']}`" + (f" … `{last['column']}`" if last is not first else "")
        meaning = first["meaning"] if last is first else f"{first['meaning']} to {last['meaning'].split()[-1]}"
        meaning = meaning[0].lower() + meaning[1:]
        unit = first["unit"] if first["unit"] not in ("", "1") else None
        items.append(f"{name}\n: {', '.join(filter(None, (first['type'], unit)))}; {meaning}\n")
    return "\n".join(items)


def spec_keys() -> str:
    """The keys of a spec."""
    return Keys(json.loads(harness("schema"))).sections("Top level")


def world_keys() -> str:
    """The keys of a world file."""
    return Keys(json.loads(harness("world", "schema"))).sections("Every key")


class Keys:
    """The keys that a JSON schema describes."""

    def __init__(self, schema: Schema):
        self.schema = schema

    def sections(self, title: str) -> str:
        """A section for the file and one for each object in it. Each key is an item of a definition list."""
        pending, parts, done = [(title, self.schema)], [], set()
        while pending:
            title, schema = pending.pop(0)
            if title in done:
                continue
            done.add(title)
            entries = []
            required = [*schema.get("required", []), *schema.get("anyOf", [{}])[-1].get("required", [])]
            for key, value in schema["properties"].items():
                inner, is_repeated = self.inner(value)
                if inner:
                    about = {"description": inner.get("description", value.get("description", ""))}
                    pending.append((f"Each entry of `{key}`" if is_repeated else f"`{key}`", inner | about))
                is_required = key in required
                entries.append(self.entry(key, value, is_required=is_required, has_keys=inner is not None))
            parts.append(f"## {title}\n\n{sentence(schema['description'])}\n\n" + "\n".join(entries))
        return "\n".join(parts)

    def resolve(self, schema: Schema) -> Schema:
        """What a reference refers to, or the schema itself. For a list that may be a single item, the list."""
        if "$ref" in schema:
            return self.schema["$defs"][schema["$ref"].rsplit("/", 1)[1]]
        first, *others = schema.get("anyOf", [schema])
        return first if others and first.get("items") == others[0] else schema

    def inner(self, schema: Schema) -> tuple[Schema | None, bool]:
        """The object with keys of its own that a key has, and whether it has several: a list or a map of them."""
        found = self.resolve(schema)
        repeated = found.get("items") or found.get("additionalProperties")
        if isinstance(repeated, dict) and (inner := self.inner(repeated)[0]):
            return inner, True
        keys = found.get("properties", {})
        # A map lists the same value for each modality. `vary` and `quick` repeat all settings by dotted key.
        has_keys = any(value != repeated for value in keys.values()) and not any("." in key for key in keys)
        return (found if has_keys else None), False

    def entry(self, key: str, schema: Schema, *, is_required: bool, has_keys: bool) -> str:
        """A key as an item of a definition list: its type, default, meaning, and the values that it can have."""
        facts = self.type_of(schema)
        if is_required:
            facts += "; required"
        elif "default" in schema and not has_keys:
            facts += f"; default `{json.dumps(schema['default'])}`"
        paragraphs = [facts, sentence(schema.get("description") or self.resolve(schema).get("description", ""))]
        values = [
            (f"`{choice['const']}`: " if "const" in choice else "") + sentence(choice.get("description", ""))
            for choice in self.choices(schema)
        ]
        if values:
            paragraphs.append("\n".join(f"- {value}" for value in values))
        body = "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
        return f"`{key}`\n: " + body.replace("\n", "\n  ").replace("\n  \n", "\n\n") + "\n"

    def choices(self, schema: Schema) -> list[Schema]:
        """The values that a key, the items of its list or the entries of its map can have, if they are listed."""
        found = self.resolve(schema)
        if "oneOf" in found:
            return found["oneOf"]
        if "anyOf" in found:
            return [value for choice in found["anyOf"] for value in self.choices(choice)]
        repeated = found.get("items") or found.get("additionalProperties")
        return self.choices(repeated) if isinstance(repeated, dict) else []

    def type_of(self, schema: Schema) -> str:
        """The values that are allowed, in words."""
        found = self.resolve(schema)
        if "oneOf" in found:
            return "one of the values below"
        if "anyOf" in found:
            return " or ".join(self.type_of(choice) for choice in found["anyOf"])
        kinds = found["type"] if isinstance(found["type"], list) else [found["type"]]
        # Null is for specs that extend another one. They may leave out any section or list.
        kinds = ["object"] if "object" in kinds else kinds
        return " or ".join(self.kind_of(kind, found) for kind in kinds)

    def kind_of(self, kind: str, schema: Schema) -> str:
        """The values of one JSON type that a schema allows, in words."""
        match kind:
            case "array":
                fewest, most = schema.get("minItems"), schema.get("maxItems")
                count = "" if most is None else f"{most} " if fewest == most else f"at most {most} "
                return f"list of {count}{plural(self.type_of(schema['items']))}"
            case "object":
                return "section"
            case "string":
                return "text"
            case "boolean":
                return "`true` or `false`"
            case "null":
                return "`null`"
        words = {
            "minimum": "of at least",
            "exclusiveMinimum": "above",
            "maximum": "at most",
            "exclusiveMaximum": "below",
        }
        bounds = [
            f"{word} {schema[bound]:,}".removesuffix(".0")
            for bound, word in words.items()
            if bound in schema and schema[bound] < LARGEST_INTEGER
        ]
        range_ = re.sub(r"^of at least (\S+) and at most ", r"from \1 to ", " and ".join(bounds))
        return f"{kind} {range_}".rstrip()


def plural(kind: str) -> str:
    """The words for several values of a kind."""
    return re.sub(r"^(integer|list|number|section|text)\b", r"\1s", kind).replace("one of the values", "the values")


def sentence(text: str) -> str:
    """A description as a sentence on one line."""
    text = " ".join(text.split())
    if not text:
        return ""
    return text[0].upper() + text[1:] + ("" if text.endswith((".", ":")) else ".")


PARTS = {"command-line": command_line, "spec-keys": spec_keys, "tables": tables, "world-keys": world_keys}


def insert(text: str) -> str:
    """A page's text with its generated parts."""
    return re.sub(
        r"<!-- generated: ([\w-]+) -->.*?<!-- end -->", lambda found: PARTS[found[1]](), text, flags=re.DOTALL
    )
