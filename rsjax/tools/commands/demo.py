"""Shows the model of the package: in a browser, or as a video and a picture. ``rsjax demo``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Opens the playground of the package's model; without a display, writes a video and a picture instead."""

    model: tyro.conf.Positional[Path] = Path("tiny")
    """A name of a model of the package, a saved model, or a run directory."""
    video: bool = False
    """Write the video and the picture, even if there is a display."""
    clip: int | None = None
    """The clip that they show. Default: the first that ends in success."""
    out: Path = Path("rsjax-demo")
    """Their directory."""
    port: int = 8642
    """The port of the playground; 0: a free one."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets, for a run directory."""


@main_errors()
def main() -> None:
    """Serves the page until Ctrl-C, or writes two files, and says what to do next."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax demo", Options.__doc__ or "", Options())
    from rsjax.model_directory import locate, output_directory
    from rsjax.tools.play.serve import ServeSettings, has_display, serve

    model = locate(options.model)
    if has_display() and not options.video:
        from rsjax.tools.policies.run_data import RunData

        serve(
            RunData(model, options.data_dir),
            None,
            "test",
            output_directory(model, "play"),
            ServeSettings(port=options.port),
        )
        return
    from rsjax.progress import note
    from rsjax.tools.pipeline.videos import write_demo

    note("generating a clip from its first frame, under its own actions and under another clip's …")
    for path in write_demo(model, options.data_dir, options.out, options.clip):
        print(path.absolute())
    print(f"next: rsjax play {options.model}, and open the address it prints; rsjax generate {options.model} --help")
