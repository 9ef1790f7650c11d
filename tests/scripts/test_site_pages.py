"""The pages that the documentation's site is given; what only MkDocs can check, make docs does."""

import re

from scripts.site_pages import ROOT, reference_pages


def test_every_command_and_every_module_of_settings_has_a_page() -> None:
    pages = reference_pages()
    commands = [path for path in (ROOT / "rsjax/tools/commands").glob("*.py") if "\ndef main(" in path.read_text()]
    for name in {path.stem for path in commands} - {"main"}:
        assert f"usage: rsjax {name} " in pages[f"reference/commands/{name}.md"]
    for path in [*(ROOT / "rsjax/config").glob("*.py"), *(ROOT / "rsjax/models").glob("*/config.py")]:
        name = path.parent.name if path.stem == "config" else path.stem
        for kind in re.findall(r"^@dataclass.*\nclass (\w+Config)\b", path.read_text(), re.MULTILINE):
            assert f"## {kind}\n" in pages[f"reference/config/{name}.md"]
