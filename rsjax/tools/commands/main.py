"""The command ``rsjax``: lists the commands, and runs one. ``rsjax play tiny``"""

import ast
import importlib
import sys
from pathlib import Path

from rsjax import __version__
from rsjax.command import main_errors
from rsjax.errors import UserError, did_you_mean
from rsjax.runtime import answer_while_importing

COMMANDS = {  # each is a module of this package with a function main
    "Start here": ("demo", "play", "generate", "finetune", "train"),
    "Data": ("doctor", "ingest", "inspect", "store", "export"),
    "Evaluate": ("evaluate", "compare", "ablation", "paper", "results", "detect"),
    "Policies": ("record", "adapt", "judge", "synthesize", "policy_learning", "policy_evaluation", "improve", "plan"),
    "Models": ("serve", "save", "hub", "describe", "compile", "bench", "convert", "replay"),
}


def main() -> None:
    """Runs the command that the first argument names, with the others; without one, lists the commands.

    A name may have dashes: ``rsjax policy-learning``.
    """
    answer_while_importing()
    word, *arguments = sys.argv[1:] or ["--help"]
    name = word.replace("-", "_")
    names = [name for group in COMMANDS.values() for name in group]
    if name in names:
        sys.argv = [f"rsjax {name}", *arguments]
        importlib.import_module(f"rsjax.tools.commands.{name}").main()
        return
    with main_errors():
        if word == "--version":
            print(f"rsjax {__version__}")
        elif word in ("-h", "--help"):
            print(overview())
        else:
            raise UserError(f"no command {word!r}{did_you_mean(name, names)} (rsjax --help lists them)")


def overview() -> str:
    """Returns the list of commands, with the first line of each one's docstring, which no import is needed for."""
    lines = ["usage: rsjax COMMAND …; each has --help. For example: rsjax demo"]
    for group, names in COMMANDS.items():
        lines += ["", group]
        for name in names:
            docstring = ast.get_docstring(ast.parse(Path(__file__).with_name(f"{name}.py").read_text())) or ""
            about, _, example = docstring.partition("\n")[0].partition(" ``")
            lines += [f"  {name:<18} {about}", f"  {'':<18} {example.partition('``')[0]}"]
    return "\n".join(lines)
