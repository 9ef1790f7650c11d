"""Settings that cannot work: each check of a configuration refuses what it is for, by name."""

import dataclasses

import pytest

from rsjax.config import ConfigError
from rsjax.evaluation.protocols import PROTOCOLS
from rsjax.tools.commands.cli import parse
from rsjax.tools.commands.train import Options

NO_STATE = "--model.state-heads on " + " ".join(
    f"--model.state-heads.{name}-weight 0" for name in ("success", "height", "opening")
)
REFUSED = {
    "tiny --eval.depth-estimator simulator:steps=0": "write simulator or simulator:steps=500",
    f"tiny {NO_STATE}": "model.state_heads is on, but all its weights are 0",
    "tiny --model.sample.keep-still on --model.sample.keep-still.noise 0": "keep_still.noise is 0.0; it must be above",
    "tiny --model.backwards.held 28": "model.backwards.held is (28,), but actions have the dimensions 0 to 27",
    "tiny --model.loss.gamma -5": "model.loss.gamma is -5.0",
    "irasim_tiny --model.error-weight 0": "model.error_weight is 0, the only term",
    "tiny --model.backwards on --model.state-heads on": "a clip that runs backwards has no labels of the state",
    "irasim_tiny --sim.second-view wrist": "models of the family irasim read one view",
    "multitask --sim.second-view wrist": "Meta-World's arm has no such camera",
    'tiny --train.curriculum [{"frames":1}]': "stage has 1 frames; a clip has at least 2",
    'tiny --tokenizer-train.curriculum [{"components":[{"annotations":"estimated"}]}]': "which only a world model can",
    "tiny --tokenizer-train.entropy-group 7": "entropy_group is 7; it must divide the 16 images",
    "cogvideox_tiny --model.autoencoder.res-blocks 0": "model.autoencoder.res_blocks is 0",
    "cogvideox_tiny --model.autoencoder.kl-weight -1": "model.autoencoder.kl_weight is -1.0",
    "cogvideox_tiny --model.autoencoder.widths 32 32": "model.autoencoder.widths are (32, 32); give one for each level",
    "cogvideox_tiny --model.autoencoder.image-noise 0 -1": "model.autoencoder.image_noise is (0.0, -1.0)",
    "cogvideox_tiny --model.text.tokens 0": "model.text.tokens is 0",
    "cogvideox_tiny --model.text.dropout 1": "model.text.dropout is 1.0",
    "cogvideox_tiny --model.text.file a --model.text.tasks b": "model.text.tasks have learned tokens",
    "cogvideox_tiny --model.blocks 0": "model.blocks is 0",
    "cogvideox_tiny --model.position-scale 0": "model.position_scale is 0.0; it must be above 0",
    "cogvideox_tiny --model.image-dropout 1": "model.image_dropout is 1.0; it is a share of the clips",
    "cogvideox_tiny --model.width 30": "model.width is 30; it must be divisible by model.heads 6",
    "cogvideox_tiny --model.sample.guidance 2": "the learned tokens of the empty text are never trained",
    "cogvideox_tiny --model.learned-positions 3 3 3": "model.learned_positions are for (3, 3, 3)",
    "cogvideox_tiny --model.noise.snr-shift 0": "model.noise.snr_shift is 0.0; it must be above 0",
    "irasim_tiny --model.noise.zero-terminal True": "set model.noise.prediction to velocity",
    "irasim_tiny --model.sample.steps 0": "model.sample.steps is 0; the sampler ddim takes at least 1",
    "irasim_tiny --model.sample.steps 5000": "model.sample.steps is 5000 of model.noise.steps 1000",
    "irasim_tiny --model.blocks 3": "model.blocks is 3; half of the blocks attend over time",
    "irasim_tiny --model.width 30": "model.width is 30; it must be divisible by model.heads 4",
    "irasim_tiny --model.heads 0": "model.heads is 0; it must be at least 1",
    "irasim_tiny --model.action-dropout 1": "model.action_dropout is 1.0; it is a share of the clips",
    "irasim_tiny --model.conditioning video --model.final-frame-ada True": "belongs to model.conditioning frame",
    "irasim_tiny --model.autoencoder.norm-groups 5": "model.autoencoder.norm_groups 5 does not divide",
    "irasim_tiny --model.autoencoder.res-blocks 0": "model.autoencoder.res_blocks is 0",
    "irasim_tiny --sim.image-size 60": "images have 60 pixels a side, which the 8 pixels of a token",
    "ivideogpt_tiny --model.dropout 1": "model.dropout is 1.0; it is a share",
    "ivideogpt_tiny --model.autoencoder.dropout 1": "model.autoencoder.dropout is 1.0; it is a share",
    "ivideogpt_tiny --model.width 30": "model.width 30 is not divisible by 2 × model.heads",
    "ivideogpt_tiny --model.use-actions False --model.integrate-actions True": "model.use_actions is False",
    "ivideogpt_tiny --model.autoencoder.widths 3": "model.autoencoder.widths are (3,); give one for each level",
    "ivideogpt_tiny --sim.image-size 60": "images have 60 pixels a side, which 16 does not divide",
    "ivideogpt_tiny --model.autoencoder.attention-size 1": "attention_size is 1; it must be at least the grid",
    "ivideogpt_tiny --model.positions 3": "has 511 tokens, but model.positions is 3",
    "ivideogpt_tiny --model.autoencoder.context-frames 99": "at least one must be left to predict",
}


@pytest.mark.parametrize("line", REFUSED)
def test_settings_that_do_not_fit_are_refused_by_name(line: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(line.split(), "rsjax train", "", Options())
    assert REFUSED[line] in str(refused.value)


@pytest.mark.parametrize(("field", "value"), [("resolution", 3), ("splits", ())])
def test_a_protocol_that_scores_nothing_is_refused(field: str, value: object) -> None:
    changes: dict[str, object] = {field: value}
    with pytest.raises(ConfigError) as refused:
        dataclasses.replace(PROTOCOLS["paper"], **changes)  # type: ignore[arg-type]
    assert "protocol paper: " in str(refused.value)
