"""Reads what the source says of each field of a dataclass, for the documentation's site and the tests."""

import ast
import inspect


def fields_of(kind: type) -> list[tuple[str, str, str, str]]:
    """Returns name, type, default and description of each field that a dataclass itself defines.

    A description is the comment behind the field, or the comments in the lines before it, as in ``--help-all``.
    """
    lines, _ = inspect.getsourcelines(kind)
    (tree,) = ast.parse(inspect.cleandoc("\n".join(line.rstrip() for line in lines))).body
    lines = inspect.cleandoc("\n".join(line.rstrip() for line in lines)).splitlines()
    assert isinstance(tree, ast.ClassDef)
    rows = []
    for node in tree.body:
        if not isinstance(node, ast.AnnAssign) or "ClassVar" in ast.unparse(node.annotation):
            continue
        text = lines[(node.end_lineno or 1) - 1].partition("  # ")[2]
        above = node.lineno - 2
        while not text and lines[above].strip().startswith("# "):
            above -= 1
        text = text or " ".join(line.strip()[2:] for line in lines[above + 1 : node.lineno - 1])
        default = "" if node.value is None else f"`{ast.unparse(node.value)}`"
        cells = (ast.unparse(node.target), ast.unparse(node.annotation), default, text)
        rows.append(tuple(cell.replace("|", "\\|") for cell in cells))
    return rows  # type: ignore[return-value]


def split_attributes(docstring: str) -> tuple[str, dict[str, str]]:
    """Returns a docstring without its section "Attributes:", and what that says of each attribute."""
    about, _, section = docstring.partition("\nAttributes:\n")
    body, _, rest = section.partition("\n\n")
    described: dict[str, str] = {}
    names: list[str] = []
    for line in body.splitlines():
        if line.startswith("     ") and names:
            for name in names:
                described[name] += f" {line.strip()}"
            continue
        head, _, text = line.strip().partition(": ")
        names = head.split(", ")
        described |= dict.fromkeys(names, text.replace("|", "\\|"))
    return f"{about}\n\n{rest}".strip(), described
