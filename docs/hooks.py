"""What MkDocs calls while it builds, and what the pages take from the code.

Between ``<!-- make: name argument -->`` and ``<!-- end -->`` stands what the function of that name in ``MAKERS``
returns; ``python benchmarks/readme.py`` writes it there, so that the pages are whole wherever they are read. Pages of
the API and of the notebooks are made while the site is built.
"""

import ast
import base64
import contextlib
import importlib
import inspect
import json
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

REPO = Path(__file__).resolve().parents[1]
PACKAGE = REPO / "dhtorch"
sys.path += [str(REPO / "docs")]  # MkDocs forgets this after the import

import licences as terms  # noqa: E402
from docstrings import markdown as as_markdown  # noqa: E402

import dhtorch  # noqa: E402
from dhtorch import codes as code_tables  # noqa: E402
from dhtorch.cli import run  # noqa: E402
from dhtorch.codes import CodeTable, Gate, Hole, Source, names, words  # noqa: E402
from dhtorch.transforms import schema  # noqa: E402
from dhtorch.viz.plots import colours as palette  # noqa: E402

_MARK = re.compile(r"^<!-- .*? -->\n", re.M)
_QUESTION = re.compile(
    r"Question: (?P<question>.*?\?)(?P<idea>.*?)(?P<when>Expectation[^:]*): (?P<expectation>.*)"
    r"What would refute it: (?P<refutation>.*)",
    re.S,
)


# ---------------------------------------------------------------------------------------------------- MkDocs' own calls


def on_config(config: Any) -> Any:
    """Notebooks follow the tutorials, the API's pages the results; the repository is where this clone came from."""
    config.repo_url = config.repo_url or origin()
    config.nav.insert(2, {"Notebooks": [{notebook_title(n): f"notebooks/{n.stem}.md"} for n in notebooks()]})
    config.nav.append({"API": [{"dhtorch": "api/dhtorch.md"}, *({part: f"api/{part}.md"} for part in parts())]})
    return config


def on_files(files: Any, config: Any) -> Any:
    """The API's pages and the notebooks, with their pictures."""
    from mkdocs.structure.files import File  # noqa: PLC0415

    for part in ("dhtorch", *parts()):
        files.append(File.generated(config, f"api/{part}.md", content=api_page(part)))
    for notebook in notebooks():
        text, figures = article(notebook)
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=text))
        for name, content in figures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page without the marks between which it is written."""
    return _MARK.sub("", markdown)


def generate(mark: str) -> str:
    """What stands under ``<!-- make: name argument -->``.

    Raises:
        ValueError: a mark that nobody makes, or that asks for something which is not there.
    """
    name, _, argument = mark.partition(" ")
    if name not in MAKERS:
        raise ValueError(f"docs: found the mark {name!r}, expected one of {', '.join(MAKERS)}")
    return MAKERS[name](*([argument] if argument else [])).strip("\n")


# ----------------------------------------------------------------------------------------- repository and notebooks


def origin() -> str:
    """Web address of the repository that this clone came from; nothing where there is none."""
    command = ["git", "-C", str(REPO), "remote", "get-url", "origin"]
    with contextlib.suppress(OSError):
        url = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip().removesuffix(".git")
        url = re.sub(r"^(?:ssh://)?git@([^:/]+)[:/]", r"https://\1/", url)
        return url if url.startswith("https://") else ""
    return ""


def notebooks() -> list[Path]:
    """The articles that run."""
    return sorted((REPO / "notebooks").glob("*.ipynb"))


def notebook_title(path: Path) -> str:
    """The first heading of a notebook."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    heading = re.search(
        r"^# +(.+)$", "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown"), re.M
    )
    return heading[1] if heading else path.stem


def article(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown with what it printed and drew: the page, and its pictures by name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(
                re.sub(r"\]\((?!https?:|#)[^)]*\)", "]", source)
            )  # files beside the notebook are not on the site
        elif cell["cell_type"] == "code":
            parts.append(f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![A figure of this article]({name})")
                continue
            text = data.get("text/markdown") or data.get("text/html")
            plain = "".join(data.get("text/plain", output.get("text", ""))).rstrip()
            parts.append("".join(text) if text else f"```text\n{plain}\n```" if plain else "")
    return "\n\n".join(parts), pictures


# ----------------------------------------------------------------------------------------------------------- the API


def parts() -> list[str]:
    """Modules and packages of dhtorch, by name."""
    modules = {p.stem for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    return sorted(modules - {"__init__", "__main__"})


def api_page(part: str) -> str:
    """One page for a module, or for a package with all its modules."""
    if part == "dhtorch":
        others = [f"| [`{p}`]({p}.md) | {_first(_doc(p))} |" for p in parts()]
        return "\n".join(["# dhtorch", "", module("dhtorch"), "", *_public_table(dhtorch), "", *_TABLE_HEAD, *others])
    files = sorted((PACKAGE / part).rglob("*.py")) if (PACKAGE / part).is_dir() else [PACKAGE / f"{part}.py"]
    package = importlib.import_module(f"dhtorch.{part}")
    if not hasattr(package, "__all__"):
        return "\n\n".join([f"# {part}", *(_module(file) for file in files)])
    public = ["## Public names", "\n".join(_public_table(package)), "## Modules, internals included"]
    return "\n\n".join([f"# {part}", *public, *(_module(file) for file in files)])


_TABLE_HEAD = ["| name | |", "| :-- | :-- |"]


def _public_table(package: ModuleType) -> list[str]:
    """``__all__`` of a package as a table: each name, linked to where it is described, and its first sentence."""
    values = [(name, getattr(package, name)) for name in package.__all__]
    names = [(n, x) for n, x in values if callable(x) or isinstance(x, ModuleType)]  # constants stand with their module
    return [*_TABLE_HEAD, *(f"| [`{n}`][{_home(package, n, x)}] | {_first(x.__doc__)} |" for n, x in names)]


def _home(package: ModuleType, name: str, value: Any) -> str:
    """The dotted name under which a public name is described."""
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, dhtorch.Method):
        return f"{_imported_from(package, name)}.{name}"
    return f"{value.__module__}.{value.__qualname__}"


def _imported_from(package: ModuleType, name: str) -> str:
    """The module from which the ``__init__`` of a package imports a name."""
    imports = (node for node in ast.walk(_tree(Path(str(package.__file__)))) if isinstance(node, ast.ImportFrom))
    return next(str(node.module) for node in imports if name in {alias.name for alias in node.names})


def _module(file: Path) -> str:
    """mkdocstrings' block for a module: what is defined in it and is public, not what it imports."""
    dotted = _dotted(file)
    members = json.dumps(list(_public(_tree(file))))
    return f"::: {dotted}\n    options:\n      members: {members}\n"


def _dotted(file: Path) -> str:
    return ".".join(file.relative_to(REPO).with_suffix("").parts).removesuffix(".__init__")


def _public(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        names: list[str] = []
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [t.id for t in targets if isinstance(t, ast.Name)]
        yield from (name for name in names if not name.startswith("_"))


@cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def _doc(part: str) -> str:
    file = PACKAGE / part / "__init__.py"
    return ast.get_docstring(_tree(file if file.is_file() else PACKAGE / f"{part}.py")) or ""


def _first(docstring: str | None) -> str:
    """The promise: the first paragraph of a docstring in one line, as Markdown."""
    return " ".join(as_markdown((docstring or "").strip().split("\n\n")[0]).split()).replace("|", "\\|")


# --------------------------------------------------------------------------------------------------- what code says


def module(dotted: str) -> str:
    """The docstring of a module."""
    file = REPO / Path(*dotted.split("."))
    file = file / "__init__.py" if file.is_dir() else file.with_suffix(".py")
    return as_markdown(ast.get_docstring(_tree(file)) or "")


def code(dotted: str) -> str:
    """The source of a function without its docstring; of a public one, which the API describes, the body alone."""
    home, _, name = dotted.rpartition(".")
    file = REPO / Path(*home.split(".")).with_suffix(".py")
    (node,) = (n for n in _tree(file).body if isinstance(n, ast.FunctionDef) and n.name == name)
    first, last = node.body[1], node.body[-1]
    lines = file.read_text(encoding="utf-8").splitlines()
    comment = first.lineno - 1
    while lines[comment - 1].strip().startswith("#"):
        comment -= 1
    body = lines[comment : last.end_lineno]
    head = lines[node.lineno - 1 : node.body[0].lineno - 1] if name.startswith("_") else []
    text = "\n".join([*head, *body]) if head else textwrap.dedent("\n".join(body))
    return f"```python\n{text}\n```"


def choices(group: str) -> str:
    """The choices of a settings group, with the words on top of each file."""
    rows = [f"| `{group}=` | |", "| :-- | :-- |"]
    for file in sorted((REPO / "conf" / group).glob("*.yaml")):
        lines = file.read_text(encoding="utf-8").splitlines()
        words = [line[1:].strip() for line in lines[: next(i for i, x in enumerate(lines) if not x.startswith("#"))]]
        words = [line for line in words if not line.startswith("Written from its record")]
        rows.append(f"| `{file.stem}` | {' '.join(words)} |")
    return "\n".join(rows)


def codes() -> str:
    """The code tables: number, name, definition, and what would help where that is known of some code."""
    shown = []
    for table in (x for x in vars(code_tables).values() if isinstance(x, type) and issubclass(x, CodeTable)):
        if table is CodeTable:
            continue
        helped = any(entry.advice for entry in table.entries.values())
        rows = ["| | | | |", "| --: | :-- | :-- | :-- |"] if helped else ["| | | |", "| --: | :-- | :-- |"]
        for number, name in names(table).items():
            entry = table.entries[number]
            more = f" {entry.advice} |" if helped else ""
            rows.append(f"| {number} | `{name}` | {entry.definition} |{more}")
        body = "\n".join(rows)
        shown.append(f"### {table.__name__}\n\n{_first(inspect.getdoc(table))}\n\n{body}")
    return "\n\n".join(shown)


def sample_columns() -> str:
    """The columns that ExtendDepth adds to a sample."""
    rows = ["| key | shape | type | unit | meaning | option |", "| :-- | :-- | :-- | :-- | :-- | :-- |"]
    for c in schema.COLUMNS:
        shape = f"({', '.join(map(str, c.shape))}{',' * (len(c.shape) == 1)})"
        kind = c.dtype if c.codes is None else f"{c.dtype}, `{c.codes.__name__}`"
        option = f"`{c.option}`" if c.option else ""
        rows.append(f"| `{c.key}` | {shape} | {kind} | {c.unit} | {c.meaning} | {option} |")
    return "\n".join(rows)


def questions() -> dict[str, dict[str, str]]:
    """Experiment → question, idea, expectation and refutation, as its docstring has them."""
    by_experiment = {}
    for file in sorted((PACKAGE / "experiments").rglob("*.py"), key=lambda p: p.stem):
        text = ast.get_docstring(_tree(file)) or ""
        if text.startswith("Question:"):
            match = _QUESTION.fullmatch(text)
            if not match:
                raise ValueError(f"{file}: expected a question, an expectation and what would refute it")
            by_experiment[file.stem] = {k: v.strip() for k, v in match.groupdict().items()} | {"module": _dotted(file)}
    return by_experiment


def experiments() -> str:
    """One row for every experiment: its question, and what is archived."""
    answers: dict[str, list[str]] = {}
    for name, result in archived().items():
        answers.setdefault(result["experiment"], []).append(f"{result['verdict']} (`{name}`)")
    rows = ["| experiment | question | archived answers |", "| :-- | :-- | :-- |"]
    for name, fields in questions().items():
        question = fields["question"][0].upper() + " ".join(fields["question"][1:].split())
        rows.append(f"| [`{name}`][{fields['module']}] | {question} | {'; '.join(answers.get(name, ['none']))} |")
    return as_markdown("\n".join(rows))


@cache
def archived() -> dict[str, dict[str, Any]]:
    """Result files that answer a question: name → result."""
    results = {}
    for file in sorted((REPO / "benchmarks" / "results").glob("*.json")):
        result = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(result, dict) and result.get("verdict"):
            results[file.stem] = result
    return results


def exit_codes() -> str:
    """Exit codes of the command."""
    return "\n".join(["| code | |", "| --: | :-- |", *(f"| {k} | {v} |" for k, v in run.EXIT_CODES.items())])


def colours() -> str:
    """The project's colours, each with a patch of itself."""
    tables = {
        "Where a depth comes from": {words(names(Source)[k]): c for k, c in palette.SOURCE_COLOURS.items()},
        "Methods": palette.METHOD_COLOURS,
        "Series that are no method, in turn": {str(k + 1): c for k, c in enumerate(palette.SERIES_COLOURS)},
        "Gates: why an answer is withheld": {words(names(Gate)[k]): c for k, c in palette.GATE_COLOURS.items()},
        "Holes: why there is no return": {words(names(Hole)[k]): c for k, c in palette.HOLE_COLOURS.items()},
    }
    parts = [_patches(title, table) for title, table in tables.items()]
    maps = {"depth": palette.DEPTH_CMAP, "1/depth": palette.INVERSE_DEPTH_CMAP, "score": palette.SCORE_CMAP}
    maps |= {"error": palette.ERROR_CMAP, "signed difference": palette.SIGNED_CMAP, "picture": palette.GREY_CMAP}
    rows = [f"| {name} | `{kind}` | {_ramp(palette.sample_cmap(kind, 33))} |" for name, kind in maps.items()]
    parts.append("\n".join(["## Colour maps, from small to large", "", "| | | |", "| :-- | :-- | :-- |", *rows]))
    return "\n\n".join(parts)


def _patches(title: str, table: Mapping[str, str]) -> str:
    rows = [f"| {name} | {_patch(colour)} |" for name, colour in table.items()]
    return "\n".join([f"## {title}", "", "| | |", "| :-- | :-- |", *rows])


def _patch(colour: str) -> str:
    style = f"display:inline-block;width:2.4em;height:1em;vertical-align:-.15em;border:1px solid;background:{colour}"
    return f'<span style="{style}"></span> `{colour.lower()}`'


def _ramp(stops: Sequence[str]) -> str:
    style = f"display:inline-block;width:16em;height:1em;background:linear-gradient(to right,{','.join(stops)})"
    return f'<span style="{style}"></span>'


def licences() -> str:
    """Direct dependencies and their licences."""
    return str(terms.table())


MAKERS: dict[str, Callable[..., str]] = {
    f.__name__: f for f in (module, code, choices, codes, sample_columns, experiments, exit_codes, licences, colours)
}
