"""The public way to sample, in PyTorch, makes the same videos, and is timed."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.pytorch.baselines import check_torch
from rsjax.clip import Video
from rsjax.config import Config, ConfigError, presets
from rsjax.data.normalization import Normalization
from rsjax.models.base import Assets
from rsjax.models.ivideogpt.config import TopKConfig
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.tools.bench.run import bench
from rsjax.tools.convert.ivideogpt import llama_table, tokenizer_table
from rsjax.tools.convert.table import to_tensors
from tests.benchmarks.pytorch.eager import EAGER
from tests.models.ivideogpt.toy import CLIPS, MODEL, frames, llama_params, vq_params
from tests.models.toy_family import ToyConfig

MOST_PROBABLE = replace(MODEL, sample=TopKConfig(top_k=1))


def test_videos_are_those_of_the_public_way_to_sample() -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("transformers")
    from benchmarks.pytorch.ivideogpt import Sampler

    llama, vq, reference = llama_params(), vq_params(), Sampler(MOST_PROBABLE, CLIPS)
    tensors = {name: torch.tensor(np.ascontiguousarray(x)) for name, x in to_tensors(llama, llama_table(MODEL)).items()}
    reference.llama.load_state_dict({name[4:]: x for name, x in tensors.items() if name.startswith("llm.")})
    reference.actions.load_state_dict({name: tensors[f"action_linear.{name}"] for name in ("weight", "bias")})
    public = to_tensors(vq, tokenizer_table(vq))
    reference.tokenizer.load_state_dict({name: torch.tensor(np.ascontiguousarray(x)) for name, x in public.items()})
    for network in (reference.llama, reference.tokenizer):
        network.eval()
    prompt, actions = frames(2, 1), np.random.default_rng(2).normal(size=(2, 4, 3)).astype(np.float32)
    theirs = reference.generate(torch.tensor(prompt).permute(0, 1, 4, 2, 3) / 255, torch.tensor(actions[:, 1:]))
    assets = Assets(Normalization((0.0,) * 3, (1.0,) * 3, None), vq)
    mine = IVideoGPT(MOST_PROBABLE, CLIPS).generate(llama, assets, Video(prompt), actions).rgb
    expected = 255 * theirs.clamp(0, 1).permute(0, 1, 3, 4, 2).numpy()
    np.testing.assert_allclose(mine, expected, atol=0.51)


def toy() -> Config:
    debug = presets.get("debug")
    vq = replace(MODEL.autoencoder, patch_size=2)
    return replace(debug, model=replace(MODEL, autoencoder=vq), sim=replace(debug.sim, frames=4))


def test_all_parts_are_timed_in_both_types() -> None:
    pytest.importorskip("torch")
    pytest.importorskip("transformers")
    numbers = bench(toy(), only=["tokenizer", "sample"], horizons=(3,), budget=0.0, rival=EAGER)
    for dtype in ("float32", "bfloat16"):
        assert numbers[f"torch_train_step_s_{dtype}"] > 0
        for name in ("sample", "tokenizer_encode", "tokenizer_decode"):
            assert numbers[f"{name}_speedup_over_torch_{dtype}"] > 0


def test_a_family_without_a_torch_baseline_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="no network of family 'toy', only of roboscape, genie, ivideogpt"):
        check_torch(replace(toy(), model=ToyConfig()))
