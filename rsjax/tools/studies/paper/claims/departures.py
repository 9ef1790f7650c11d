"""Our choices that depart from the paper or the public code, each compared with what these say."""

from typing import Any

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register

_METRICS = ("psnr", "delta_psnr")


def _departure(name: str, title: str, statement: str, letter: dict[str, Any], metrics: tuple[str, ...]) -> None:
    """Registers the claim that our choice is better than ``letter``, the values of the paper or the public code."""
    register(
        Claim(
            name=f"departure-{name}",
            title=title,
            statement=statement,
            place="a choice of ours",
            arms=(Arm("ours"), Arm("to the letter", letter)),
            comparisons=pairs("ours", "to the letter", *metrics),
            rank=5,
        )
    )


_departure(
    "actions",
    "The network reads the sum of all actions so far",
    "The sum of pose deltas is the pose; a small model in few steps does not find it by temporal attention alone.",
    {"model.departures.integrate_actions": False},
    _METRICS,
)
_departure(
    "optimizer",
    "Muon instead of AdamW",
    "Muon learns more in few steps. The paper names no optimizer; the public Genie uses AdamW (here at 1e-3).",
    {"train.optimizer": "adamw", "train.optimizer.learning_rate": 1e-3},
    _METRICS,
)
_departure(
    "local-codes",
    "Codes that depend on their own pixels alone",
    "With MAGVIT-2's encoder a moving arm changes codes far from it, which the model has to predict too.",
    {"tokenizer.local_codes": False},
    _METRICS,
)
_departure(
    "vocabularies",
    "Six vocabularies of 8 codes instead of two of 512",
    "Many codes of a validation clip never occur in the training clips, but their sub-tokens do.",
    {"tokenizer.vocabularies": 2},
    _METRICS,
)
_departure(
    "clean-contexts",
    "Contexts without corruption",
    "In few steps the corrupted contexts of the public Genie's recipe cost more than they gain.",
    {"model.corruption": "on"},
    _METRICS,
)
_departure(
    "norms",
    "Norms before temporal attention and the heads, smaller embeddings",
    "Small models trained for few steps learn faster with norms that the public Genie lacks.",
    {"model.departures.more_norms": False, "model.departures.embedding_std": 0.0},
    _METRICS,
)
_departure(
    "keypoint-anchor",
    "Eq. 5 pulls towards the code of the true first frame",
    "The paper's anchor ŝ₁ is the output at the prompt, which no cross-entropy trains.",
    {"model.departures.observed_anchor": False},
    ("delta_psnr_uniform", *_METRICS),
)

_departure(
    "moved-copies",
    "Moved copies of the training clips",
    "A scene that is moved by less than a token has other tokens everywhere, so few clips are not memorised.",
    {"model.departures.shifts": 0},
    _METRICS,
)
_departure(
    "read-previous",
    "Every frame's input has the tokens of the frame before it",
    "What stays need not be found by temporal attention first.",
    {
        "model.departures.read_previous": False,
        "model.departures.whole_frames": False,
        "model.departures.self_conditioning": 0.0,
    },
    _METRICS,
)
_departure(
    "whole-frames",
    "All cells of every frame masked, instead of a share of them",
    "Decoding in one step begins with no cell of the frame, so training on shares of it asks something else.",
    {"model.departures.whole_frames": False, "model.departures.self_conditioning": 0.0},
    _METRICS,
)
_departure(
    "own-frames",
    "Frames predicted from the model's own predictions in half of the steps",
    "A rollout reads what the model made, which training on true frames alone never shows it.",
    {"model.departures.self_conditioning": 0.0},
    _METRICS,
)
_departure(
    "mean-codes",
    "Pictures of mean codes instead of the most probable ones",
    "Where the model is unsure, the mean of what may be there is closer to the truth than a guess.",
    {"model.sample.mean_codes": False},
    _METRICS,
)
_departure(
    "read-means",
    "Later frames read mean codes instead of the most probable ones",
    "What the model was unsure of in one frame is not lost to the next ones.",
    {"model.sample.read_means": False},
    _METRICS,
)
