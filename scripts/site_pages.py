"""Adds pages to the documentation's site that are made, and leads links to files of the repository to pages.

A hook of MkDocs (``mkdocs.yml``): ``make docs`` builds the site. Three kinds of pages are made: the README, the lab
notebooks, the Jupyter notebooks of examples/ and the files for contributors, as they are; each source file or folder
that a page links to; and the reference, from docstrings: the Python API, the fields of every configuration, and each
command's options.
"""

import contextlib
import dataclasses
import importlib
import inspect
import io
import json
import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

from scripts.field_comments import fields_of, split_attributes

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(\]\()([^)\s#]+)?(#[^)\s]*)?(\))")
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|obj):<code>~?([^<]*)</code>")
AS_THEY_ARE = {
    "README.md": "project/readme.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
    "SECURITY.md": "project/security.md",
}
API = {
    "Load and generate": ("rsjax.load", "rsjax.open_store", "rsjax.write_store", "rsjax.models.trained", "rsjax.clip"),
    "Stores of clips": ("rsjax.data.store", "rsjax.data.build", "rsjax.data.loader"),
    "Families of models": ("rsjax.models.base", "rsjax.models.branch_states", "rsjax.tokenizers.autoencoder"),
    "Metrics": ("rsjax.evaluation.registry", "rsjax.evaluation.evaluate", "rsjax.evaluation.protocols"),
    "Worlds for policies": (
        "rsjax.tools.policies.worlds.environments",
        "rsjax.tools.policies.worlds.world",
        "rsjax.tools.policies.judges.judge",
        "rsjax.tools.policies.planning.planner",
        "rsjax.tools.serve.client",
    ),
    "Readers of data sets": ("rsjax.tools.ingest.episode",),
}
SHIM = "https://unpkg.com/iframe-worker/shim"
NO_FIELDS = ("__init__", "config_fields", "fields", "presets", "metaworld")  # modules of rsjax.config
CODE = {".py": "python", ".sh": "bash", ".cfg": "ini", ".yaml": "yaml", ".yml": "yaml", ".json": "json", ".j2": "html"}

_sites: dict[str, str] = {}  # a path in the repository → the page's path in the site
_origins: dict[str, str] = {}  # the reverse


def on_config(config: Any) -> Any:
    """Makes anchors as GitHub makes them, and adds the reference to the navigation."""
    from pymdownx.slugs import slugify

    config["mdx_configs"]["toc"]["slugify"] = slugify(case="lower")
    sections = {next(iter(section)): next(iter(section.values())) for section in config["nav"]}
    reference = sections["Reference"]
    if not any("Commands" in entry for entry in reference if isinstance(entry, dict)):
        commands = [{name: f"reference/commands/{name}.md"} for name in _commands()]
        fields = [{name.replace("_", " "): f"reference/config/{name}.md"} for name in _config_modules()]
        api = [{title: f"reference/api/{_name(title)}.md"} for title in API]
        reference.extend([{"Commands": commands}, {"Configuration": fields}, {"Python API": api}])
        notebooks = [f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.md"))]
        sections["Lab results"].append({"Lab notebooks": notebooks})
        sections["Start here"].append({"Notebooks": [example_page(name) for name in examples()]})
        sections["Explanation"] += [{"Changes": AS_THEY_ARE["CHANGELOG.md"]}, {"Security": AS_THEY_ARE["SECURITY.md"]}]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds the made pages, and those of all files of the repository that pages link to."""
    from mkdocs.structure.files import File, InclusionLevel  # only a build of the site has this package

    made = reference_pages()
    own = {file.src_uri for file in files.documentation_pages()}
    waiting = [f"docs/{page}" for page in sorted(own)]
    for name in waiting:
        _register(name, name.removeprefix("docs/"))
    for name, page in AS_THEY_ARE.items():
        _register(name, page)
    for path in sorted((ROOT / "notebooks").glob("*.md")):
        _register(f"notebooks/{path.name}", f"notebooks/{path.name}")
    for name in examples():
        _register(name, example_page(name))
    waiting += [name for name in _sites if name not in waiting]
    done: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in done:
            continue
        done.add(name)
        page = _sites[name]
        if page not in own:
            made[page] = repository_page(name)
        if name.endswith(".md"):
            for target in linked(name):
                if target not in _sites and (not target.startswith("docs/") or (ROOT / target).is_dir()):
                    _register(target, _source_page(target))
                if target in _sites:
                    waiting.append(target)
    for page, text in made.items():
        inclusion = InclusionLevel.NOT_IN_NAV if page.startswith("source/") else InclusionLevel.INCLUDED
        files.append(File.generated(config, page, content=text, inclusion=inclusion))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Leads links to files of the repository to their pages."""
    own = _origins.get(page.file.src_uri)
    if own is None:
        return markdown

    def moved(found: re.Match[str]) -> str:
        target = found[2]
        if not target or "://" in target:
            return found[0]
        name = _resolve(own, target)
        if name not in _sites and name.startswith("docs/"):
            site = name.removeprefix("docs/")  # a picture
            if not (ROOT / name).exists():
                return found[0]
        elif name in _sites:
            site = _sites[name]
        else:
            return found[0]
        anchor = found[3] or ""
        if not name.endswith(".md"):
            anchor = ""
        return f"{found[1]}{posixpath.relpath(site, posixpath.dirname(page.file.src_uri) or '.')}{anchor}{found[4]}"

    return LINK.sub(moved, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Makes links of the roles in docstrings, such as ``:class:`Store```."""
    return ROLE.sub(_reference, html)


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Takes what the search needs in pages opened from the disk from the site itself, not from another site."""
    return output.replace(SHIM, posixpath.relpath("assets/iframe-worker.js", posixpath.dirname(page.url) or "."))


def linked(name: str) -> list[str]:
    """Returns the files and folders of the repository that a page links to."""
    found = []
    for link in LINK.finditer((ROOT / name).read_text()):
        if link[2] and "://" not in link[2]:
            target = _resolve(name, link[2])
            if (ROOT / target).exists() and not target.startswith(".."):
                found.append(target)
    return found


def reference_pages() -> dict[str, str]:
    """Returns the pages of commands, configuration and Python API by their paths."""
    made = {f"reference/commands/{name}.md": command_page(name) for name in _commands()}
    made |= {f"reference/config/{name}.md": config_page(name, module) for name, module in _config_modules().items()}
    return made | {f"reference/api/{_name(title)}.md": module_page(title, modules) for title, modules in API.items()}


def repository_page(name: str) -> str:
    """Returns the page of a file or folder: Markdown as it is, code in a block, a folder as its README and a list."""
    path = ROOT / name
    if path.is_dir():
        readme = path / "README.md"
        files = [f"- `{each.name}`" for each in sorted(path.iterdir()) if not each.name.startswith(("_", "."))]
        text = ""
        if readme.exists():
            text = f"{readme.read_text().partition(chr(10))[2].strip()}\n"
        return f"---\nsearch:\n  exclude: true\n---\n# {name}/\n\n{text}\n" + "\n".join(files) + "\n"
    if path.suffix == ".md":
        return path.read_text()
    if path.suffix == ".ipynb":
        return notebook_text(path)
    code = path.read_text()
    return f"---\nsearch:\n  exclude: true\n---\n# {name}\n\n`````{CODE.get(path.suffix, 'text')}\n{code}`````\n"


def examples() -> list[str]:
    """Returns the paths of the Jupyter notebooks in the repository."""
    return [f"examples/{path.name}" for path in sorted((ROOT / "examples").glob("*.ipynb"))]


def example_page(name: str) -> str:
    """Returns the path of a Jupyter notebook's page in the site."""
    return f"{name.removesuffix('.ipynb')}.md"


def notebook_text(path: Path) -> str:
    """Returns a Jupyter notebook as Markdown: its text as it is, its code in blocks."""
    parts = []
    for cell in json.loads(path.read_text())["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            text = f"```python\n{text}\n```"
        parts.append(text)
    return "\n\n".join(parts) + "\n"


def command_page(name: str) -> str:
    """Returns the page of a command: its help, as it prints it."""
    module = importlib.import_module(f"rsjax.tools.commands.{name}")
    about, _, example = (module.__doc__ or "").partition("\n")[0].partition(" ``")
    parts = [f"# rsjax {name}", about]
    if example:
        parts.append(f"```bash\n{example.partition('``')[0]}\n```")
    shown = help_of(name, ["--help"])
    parts.append(f"## --help\n\n```text\n{shown.strip()}\n```")
    if f"{name} tiny --help" in shown:
        parts.append(f"## tiny --help\n\n```text\n{help_of(name, ['tiny', '--help']).strip()}\n```")
    return "\n\n".join(parts) + "\n"


def help_of(name: str, words: list[str]) -> str:
    """Returns what a command prints for these arguments; it does not restart the process, as commands do to tune it."""
    out = io.StringIO()
    with (
        patch.object(sys, "argv", [f"rsjax {name}", *words]),
        patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}),
        contextlib.redirect_stdout(out),
        contextlib.suppress(SystemExit),
    ):
        importlib.import_module(f"rsjax.tools.commands.{name}").main()
    return re.sub(r" +$", "", out.getvalue(), flags=re.MULTILINE)


def config_page(name: str, module: str) -> str:
    """Returns the page of a module of configuration: a table of the fields of each of its dataclasses."""
    imported = importlib.import_module(module)
    parts = [f"# {name.replace('_', ' ')}", inspect.getdoc(imported) or ""]
    sections = _sections()
    for kind in vars(imported).values():
        if not (isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module):
            continue
        about, described = split_attributes(inspect.getdoc(kind) or "")
        parts += [f"## {kind.__name__}", about]
        if kind in sections:
            parts.append("Flags: " + ", ".join(f"`--{section}.FIELD`" for section in sorted(sections[kind])))
        rows = []
        for field, hint, default, text in fields_of(kind):
            rows.append(f"| `{field}` | `{hint}` | {default} | {text or described.get(field, '')} |")
        parts.append("\n".join(["| Field | Type | Default | |", "|---|---|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def module_page(title: str, modules: tuple[str, ...]) -> str:
    """Returns the page of some modules, which mkdocstrings fills from their docstrings."""
    return f"# {title}\n\n" + "\n\n".join(f"::: {name}" for name in modules) + "\n"


def _commands() -> list[str]:
    from rsjax.tools.commands.main import COMMANDS

    return [name for names in COMMANDS.values() for name in names]


def _config_modules() -> dict[str, str]:
    """Returns the modules of configuration by the name of their page."""
    own = sorted(path.stem for path in (ROOT / "rsjax" / "config").glob("*.py"))
    modules = {name: f"rsjax.config.{name}" for name in own if name not in NO_FIELDS}
    families = sorted(path.parent.name for path in (ROOT / "rsjax" / "models").glob("*/config.py"))
    return modules | {name: f"rsjax.models.{name}.config" for name in families}


def _sections() -> dict[type, set[str]]:
    """Returns where each dataclass stands in the presets, such as ``train.optimizer``."""
    from rsjax.config import presets

    found: dict[type, set[str]] = {}

    def visit(part: Any, path: str) -> None:
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            section = f"{path}{field.name}".replace("_", "-")
            if dataclasses.is_dataclass(value):
                found.setdefault(type(value), set()).add(section)
                visit(value, f"{section}.")
            elif value is None:  # a section that is off
                for kind in get_args(field.type):
                    if dataclasses.is_dataclass(kind):
                        found.setdefault(kind, set()).add(section)  # type: ignore[arg-type]

    for name in presets.PRESETS:
        visit(presets.get(name), "")
    return found


def _name(title: str) -> str:
    return title.lower().replace(" ", "_")


def _register(name: str, page: str) -> None:
    _sites[name] = page
    _origins[page] = name


def _source_page(name: str) -> str:
    if name.endswith(".md"):
        return f"source/{name}"
    if (ROOT / name).is_dir():
        return f"source/{name}/index.md"
    return f"source/{name}.md"


def _resolve(name: str, target: str) -> str:
    """Returns the path in the repository that a link of a file means."""
    folder = name if (ROOT / name).is_dir() else posixpath.dirname(name)
    return posixpath.normpath(posixpath.join(folder, target)).rstrip("/")


def _reference(found: re.Match[str]) -> str:
    name = found[1]
    return f'<autoref identifier="{name}" optional><code>{name.rpartition(".")[2]}</code></autoref>'
