"""Imports and exports public checkpoints. ``python -m experiments.convert tokenizer IN OUT``"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rsjax.command import main_errors, refuse_repeated

PROG = "python -m experiments.convert"


KINDS = {
    "tokenizer": "Open-MAGVIT2's image tokenizer, either generation",
    "genie": "1xgpt's Genie (STMaskGIT); reads the config.json beside IN",
    "ivideogpt": "iVideoGPT's tokenizer or transformer, whichever IN holds",
    "irasim": "IRASim's transformer, Frame-Ada or Video-Ada",
    "sdxl": "the autoencoder of Stable Diffusion XL; reads the config.json beside IN",
    "cogvideox": "CogVideoX's autoencoder or transformer, whichever IN holds; reads the config.json beside IN",
    "text": "texts: IN is a local directory with CogVideoX's text_encoder and tokenizer, OUT their embeddings",
    "lpips": "the perceptual distance: torchvision's backbone and the published heads",
}


def parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    top = argparse.ArgumentParser(PROG, description="Imports and exports PyTorch and safetensors checkpoints.")
    kinds = top.add_subparsers(dest="kind", required=True, metavar="|".join(KINDS))
    for kind, text in KINDS.items():
        command = kinds.add_parser(kind, help=text, description=text)
        command.add_argument("source", metavar="IN", type=Path, help="a public file, or a directory made here")
        command.add_argument("out", metavar="OUT", type=Path, help="a directory, or a .safetensors file")
        if kind == "tokenizer":
            command.add_argument("--weights", choices=("raw", "ema"), default="raw", help="ema: their moving average")
        if kind == "genie":
            command.add_argument("--heads", type=int, help="attention heads, if there is no config.json")
        if kind == "ivideogpt":
            command.add_argument("--heads", type=int, help="attention heads of the transformer, if not of 64 channels")
        if kind == "text":
            command.add_argument("--task", action="append", default=[], help="a task, in words; as often as needed")
            command.add_argument("--store", type=Path, help="a store of clips, whose tasks are embedded")
            command.add_argument("--tokens", type=int, default=226, help="tokens of each text")
        if kind in ("ivideogpt", "cogvideox"):
            command.add_argument(
                "--part", choices=("tokenizer", "world_model"), help="which one to export, if there are both"
            )
        if kind == "irasim":
            command.add_argument(
                "--weights", choices=("ema", "raw"), default="ema", help="raw: not their moving average"
            )
            command.add_argument("--heads", type=int, help="attention heads, if the width is none of the public sizes")
        if kind == "lpips":
            command.add_argument("--heads-file", type=Path, help="the published heads, if IN is only the backbone")
    return top


@main_errors()
def main(argv: Sequence[str]) -> None:
    """Converts and prints what was written."""
    refuse_repeated(argv, repeatable=("task",))
    options = parser().parse_args(argv)
    # JAX is loaded only now, after arguments are known to be good.
    from rsjax.tools.convert import cogvideox, genie, irasim, ivideogpt, kl_autoencoder, lpips, tokenizer

    if options.kind == "tokenizer":
        lines = tokenizer.convert(options.source, options.out, options.weights)
    elif options.kind == "genie":
        lines = genie.convert(options.source, options.out, options.heads)
    elif options.kind == "ivideogpt":
        lines = ivideogpt.convert(options.source, options.out, options.heads, options.part)
    elif options.kind == "cogvideox":
        lines = cogvideox.convert(options.source, options.out, options.part)
    elif options.kind == "text":
        texts = (options.task, options.store, options.tokens)
        lines = cogvideox.embed_texts(options.source, options.out, *texts)
    elif options.kind == "irasim":
        lines = irasim.convert(options.source, options.out, options.weights, options.heads)
    elif options.kind == "sdxl":
        lines = kl_autoencoder.convert(options.source, options.out)
    else:
        lines = lpips.convert([path for path in (options.source, options.heads_file) if path], options.out)
    print(*lines, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
