"""The presets: complete named configurations, one function each."""

from dataclasses import replace

from rsjax.config import (
    AdamW,
    AdversarialConfig,
    ComponentConfig,
    Config,
    ConfigError,
    CurriculumStageConfig,
    DataConfig,
    Departures,
    DepthHead,
    EvalConfig,
    GenieConfig,
    LossConfig,
    Muon,
    PerceptualConfig,
    RoboScapeConfig,
    RuntimeConfig,
    SampleConfig,
    SimConfig,
    StateHeadsConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
    TrainConfig,
)
from rsjax.config.metaworld import ML10, ML10_UNSEEN
from rsjax.config.run import FULL_SIZE_EVAL
from rsjax.errors import did_you_mean
from rsjax.models.cogvideox.presets import cogvideox_2b, cogvideox_5b_i2v, cogvideox_tiny
from rsjax.models.irasim.presets import irasim_b, irasim_l, irasim_rgbd_tiny, irasim_s, irasim_tiny, irasim_xl
from rsjax.models.ivideogpt.presets import ivideogpt_64, ivideogpt_256, ivideogpt_tiny


def debug() -> Config:
    """Runs all six stages in about a minute on a CPU, as the integration test. Its pictures are noise."""
    return Config(
        name="debug",
        sim=SimConfig(episodes=8, test_episodes=2, frames=6, tracks=64),
        tokenizer=TokenizerConfig(
            patch_size=4,
            channels=16,
            channel_multipliers=(1, 2),
            res_blocks=1,
            norm_groups=8,
            code_bits=8,
        ),
        tokenizer_train=TokenizerTrainConfig(steps=6, batch_size=2),
        model=RoboScapeConfig(
            width=32,
            blocks=2,
            heads=2,
            departures=Departures(observed_anchor=True, visible_keypoints=True),
            loss=LossConfig(num_keypoints=8),
        ),
        train=TrainConfig(steps=4, batch_size=2),
        runtime=RuntimeConfig(log_every=2, checkpoint_every=2),
        eval=EvalConfig(clips=2, batch_size=2, action_draws=1, localiser_steps=10, weights=""),
    )


def tiny() -> Config:
    """Trains on a robot arm that lifts a cube, in about half an hour on 2 CPU cores: what is best at this size.

    Depth is a second head on the branch of RGB (docs/results/depth.md). 3,400 steps take as long as the 1,700 of
    ``roboscape_tiny``, whose steps have twice the operations.
    """
    small = _physics("tiny", roboscape_tiny())
    return replace(small, train=replace(small.train, steps=3400))


def tiny_policies() -> Config:
    """Trains the package's ``tiny`` further, on clips in which position decides: for policies (docs/contacts.md).

    It also learns to read success and the state of the scene.
    """
    small = tiny()
    recipe = ("expert=0.2", "grasps=0.35", "driving=0.05", "midway=0.3", "novices=0.05", "slips=0.05")
    model = small.model
    assert isinstance(model, RoboScapeConfig)
    return replace(
        small,
        name="tiny_policies",
        sim=replace(small.sim, episodes=1600, recipe=recipe),
        tokenizer_train=replace(small.tokenizer_train, start_from="tiny", steps=0),
        model=replace(
            model,
            # It has learned to read its own frames.
            departures=replace(model.departures, self_conditioning_after=0),
            state_heads=StateHeadsConfig(),
        ),
        train=replace(
            small.train, start_from="tiny", steps=2500, optimizer=replace(small.train.optimizer, learning_rate=3e-3)
        ),
    )


def roboscape_tiny() -> Config:
    """Returns the paper's two branches and all its losses, with departures, at the size of ``tiny``."""
    return Config(
        name="roboscape_tiny",
        sim=SimConfig(episodes=800, test_episodes=100, camera="near"),
        # Six vocabularies of 8 codes: many codes of a validation clip never occur in the training clips, but their
        # sub-tokens do.
        tokenizer=TokenizerConfig(
            # Patches of 4 pixels are fast; the time that they save goes to the model, which limits quality.
            patch_size=4,
            channels=64,
            channel_multipliers=(1, 2),
            res_blocks=1,
            norm_groups=8,
            local_codes=True,
            vocabularies=6,
            compute_dtype="bfloat16",
        ),
        # Small batches, since in a few minutes the number of steps matters most. The weights are chosen for PSNR; the
        # reference's entropy weight (0.1) spreads codes further at the cost of reconstruction.
        tokenizer_train=TokenizerTrainConfig(
            steps=1100,
            batch_size=8,
            frames_per_clip=2,
            depth_share=0.2,
            optimizer=Muon(learning_rate=5e-3, final_share=0.02),
            ema=0.998,
            l1_weight=0.2,
            l2_weight=4.0,
            entropy_weight=0.01,
            entropy_offset=0.0,  # the true entropy, with which these weights were chosen
            commitment_weight=0.1,
        ),
        model=RoboScapeConfig(
            width=128,
            blocks=4,
            unroll=4,
            heads=4,
            departures=Departures(
                integrate_actions=True,
                read_previous=True,
                whole_frames=True,
                more_norms=True,
                embedding_std=0.5,
                shifts=3,
                self_conditioning=0.5,
                self_conditioning_after=500,
                observed_anchor=True,
                visible_keypoints=True,
            ),
            compute_dtype="bfloat16",
            corruption=None,
            sample=SampleConfig(steps=1, mean_codes=True, read_means=True),
        ),
        train=TrainConfig(
            steps=1700,
            batch_size=4,
            accumulate=2,  # half the memory, and faster on a CPU
            optimizer=Muon(learning_rate=5e-3, final_share=0.02),
            ema=0.995,
        ),
        runtime=RuntimeConfig(checkpoint_every=500, eval_every=1000),
        eval=EvalConfig(clips=100, batch_size=20),
    )


def multitask() -> Config:
    """Trains on the ten training tasks of Meta-World's ML10, in about half an hour on 2 CPU cores.

    Depth is a second head, as in ``tiny``.
    """
    small = _physics("multitask", roboscape_multitask())
    return replace(small, train=replace(small.train, steps=3400))


def roboscape_multitask() -> Config:
    """Returns ``roboscape_tiny`` on the ten training tasks of ML10; those it holds out are the protocol "unseen"'s."""
    small = roboscape_tiny()
    return replace(
        small,
        name="roboscape_multitask",
        sim=SimConfig(
            episodes=1000,
            test_episodes=100,
            control_steps=7,  # 11 frames a second: 105 control steps, in which most experts finish
            camera="near",
            env="metaworld",
            tasks=ML10,
            unseen_tasks=ML10_UNSEEN,
        ),
        tokenizer_train=replace(small.tokenizer_train, steps=1400),
        train=replace(small.train, steps=2400),
    )


def roboscape_s() -> Config:
    """Returns the paper's smallest model, "34M": the size of one of its two branches, without actions."""
    return _full_size("roboscape_s", RoboScapeConfig())


def roboscape_m() -> Config:
    """Returns the paper's middle model, "131M"."""
    return _full_size("roboscape_m", RoboScapeConfig(width=512))


def roboscape_l() -> Config:
    """Returns the paper's largest model, "544M"."""
    return _full_size("roboscape_l", RoboScapeConfig(width=1024, heads=16))


def roboscape_agibot() -> Config:
    """Returns ``roboscape_s`` on AgiBot-World: the paper's own data, which ``rsjax ingest`` makes (docs/agibot.md).

    Clips have 16 frames at 2 Hz and actions of 16 numbers. The tokenizer is a public MAGVIT-2 that stays frozen, since
    the authors' "was trained on large-scale, general RGB image and video datasets, not specially for colorized depth
    images". Curriculum, 1,200 test clips and five evaluations of each are those of ``roboscape_s``.
    """
    shape = DataConfig(store="", key="", frames=16, image_size=256, tracks=256, action_dim=16, test_clips=1200)
    return replace(
        roboscape_s(),
        name="roboscape_agibot",
        data=shape,
        tokenizer_train=TokenizerTrainConfig(steps=0, start_from="magvit2"),
    )


def _physics(name: str, config: Config) -> Config:
    """Returns a preset with depth as a second head and without keypoint terms, which docs/results/depth.md measures.

    A step costs 1.005 times that of the same network without depth; the paper's branch costs 2.06 times as much.
    """
    model = config.model
    assert isinstance(model, RoboScapeConfig)
    return replace(
        config,
        name=name,
        model=replace(model, depth=DepthHead(), loss=replace(model.loss, keypoints="none")),
    )


def genie_35m() -> Config:
    """Returns the public Genie (1xgpt's GENIE_35M): RGB only, no actions, half of the frames as prompt."""
    return replace(_full_size("genie_35m", GenieConfig(action_encoder="none")), prompt_frames=8)


def genie_138m() -> Config:
    """Returns the larger public Genie (1xgpt's GENIE_138M)."""
    return replace(_full_size("genie_138m", GenieConfig(width=512, action_encoder="none")), prompt_frames=8)


def genie_35m_actions() -> Config:
    """Returns the paper's baseline: the public Genie's network with actions through an MLP and one prompt frame."""
    return _full_size("genie_35m_actions", GenieConfig())


def _full_size(name: str, model: RoboScapeConfig | GenieConfig) -> Config:
    """Returns a preset with 256² pixels, 16 frames of 16×16 tokens, 32 blocks, and the paper's λ and γ (the defaults).

    The authors give 32 blocks, and 8 heads for their width of 256; 16 heads where a head would be wider than 64 is our
    choice. They give neither optimizer nor batch size. Optimizer: AdamW with linear decay, as in the public code.
    Curriculum: the authors' 2 epochs of simple tasks, then 3 of difficult ones, for their own model. Steps without one:
    5 epochs of 6.5 million clips, at a batch of 256.
    """
    simple_then_difficult = (
        CurriculumStageConfig((ComponentConfig(difficulties=("simple",)),), 2.0),
        CurriculumStageConfig((ComponentConfig(difficulties=("difficult",)),), 3.0),
    )
    return Config(
        name=name,
        sim=SimConfig(image_size=256),
        tokenizer=TokenizerConfig(compute_dtype="bfloat16"),
        # Open-MAGVIT2: Adam, 256 images a step, 270 epochs of ImageNet, the rate divided by 10 after 200 and 250 of
        # them. LPIPS needs the path of its weights, --tokenizer-train.perceptual.lpips.
        tokenizer_train=TokenizerTrainConfig(
            steps=1_350_000,
            batch_size=64,
            frames_per_clip=4,
            optimizer=AdamW(
                warmup_steps=0, schedule="steps", drop_at=(200 / 270, 250 / 270), betas=(0.5, 0.9), grad_clip=0.0
            ),
            ema=0.999,
            flip=True,
            perceptual=PerceptualConfig(),
            entropy_group=8,
            adversarial=AdversarialConfig(),
        ),
        model=replace(
            model,
            compute_dtype="bfloat16",
            remat="blocks",
            sample=SampleConfig(cache_dtype="bfloat16"),
        ),
        train=TrainConfig(
            steps=127_000,
            curriculum=simple_then_difficult if isinstance(model, RoboScapeConfig) else (),
            batch_size=256,
            optimizer=AdamW(betas=(0.9, 0.999), schedule="linear", final_share=0.0),
        ),
        runtime=RuntimeConfig(log_every=100, checkpoint_every=1000, eval_every=5000),
        eval=FULL_SIZE_EVAL,
    )


def collect(*configs: Config) -> dict[str, Config]:
    """Returns the configurations by name.

    Raises:
        ConfigError: two have the same name.
    """
    presets: dict[str, Config] = {}
    for config in configs:
        if config.name in presets:
            raise ConfigError(f"two presets are named {config.name!r}; rename one of them in rsjax/config/presets.py")
        presets[config.name] = config
    return presets


PRESETS = collect(
    debug(),
    tiny(),
    tiny_policies(),
    multitask(),
    roboscape_s(),
    roboscape_m(),
    roboscape_l(),
    roboscape_agibot(),
    roboscape_tiny(),
    roboscape_multitask(),
    _physics("roboscape_physics_tiny", roboscape_tiny()),
    _physics("roboscape_physics_s", roboscape_s()),
    _physics("roboscape_physics_m", roboscape_m()),
    _physics("roboscape_physics_l", roboscape_l()),
    genie_35m(),
    genie_138m(),
    genie_35m_actions(),
    ivideogpt_64(),
    ivideogpt_256(),
    ivideogpt_tiny(tiny()),
    irasim_s(),
    irasim_b(),
    irasim_l(),
    irasim_xl(),
    irasim_tiny(tiny()),
    irasim_rgbd_tiny(tiny()),
    cogvideox_2b(),
    cogvideox_5b_i2v(),
    cogvideox_tiny(tiny()),
)


def get(name: str) -> Config:
    """Returns the preset called ``name``.

    Raises:
        ConfigError: the name is unknown; the message suggests the closest and lists all.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}{did_you_mean(name, PRESETS)} (presets: {', '.join(PRESETS)})")
    return PRESETS[name]
