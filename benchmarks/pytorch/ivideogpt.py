"""iVideoGPT in plain eager PyTorch, with the LLaMA of ``transformers``; both are optional packages.

Axes: B clips, c context frames, F later frames, L tokens of a sequence, A action dimensions.
"""

import torch
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM

from benchmarks.pytorch.conditional_vq import ConditionalVQTorch
from benchmarks.pytorch.measure import TorchWork
from rsjax.config import ClipShape, Config
from rsjax.models.ivideogpt.config import IVideoGPTConfig
from rsjax.models.ivideogpt.sequence import Layout


class Sampler:
    """Generates videos from prompts as the public code does: each frame begins with a pass over all earlier tokens."""

    def __init__(self, config: IVideoGPTConfig, clips: ClipShape) -> None:
        self.layout = Layout.create(config, clips.image_size)
        settings = LlamaConfig(
            vocab_size=self.layout.vocabulary,
            hidden_size=config.width,
            intermediate_size=config.mlp_width,
            num_hidden_layers=config.blocks,
            num_attention_heads=config.heads,
            max_position_embeddings=config.positions,
            attention_dropout=config.dropout,
        )
        self.tokenizer = ConditionalVQTorch(config.autoencoder, clips.image_size)
        self.inputs = clips.action_dim * (1 + config.integrate_actions)
        self.llama = LlamaForCausalLM(settings)
        self.actions = nn.Linear(self.inputs, config.width)
        self.temperature = config.sample.temperature or 1.0
        self.top_k = config.sample.top_k or self.layout.vocabulary

    def loss(self, tokens: Tensor, actions: Tensor) -> Tensor:
        """Returns the mean cross-entropy of sequences (B, L) after the first slot; actions (B, F, A)."""
        first = self.layout.first_slot
        labels = tokens.masked_fill(torch.arange(tokens.shape[1], device=tokens.device) <= first, -100)
        return self.llama(inputs_embeds=self._embedded(tokens, actions), labels=labels).loss

    @torch.no_grad()
    def generate(self, frames: Tensor, actions: Tensor) -> Tensor:
        """Returns videos (B, c + F, 3, H, W) from context frames (B, c, 3, H, W) and actions (B, F, A)."""
        layout = self.layout
        clips, count = frames.shape[:2]
        stand_in = torch.cat([frames, frames[:, -1:]], 1)  # the tokenizer needs at least one later frame
        context = self.tokenizer.tokenize(stand_in)[0]
        separators = torch.full((clips, count, 1), layout.separator, device=frames.device)
        tokens = torch.cat([separators, context], 2).flatten(1)[:, 1:]
        slot = torch.full((clips, 1), layout.slot, device=frames.device)
        for _ in range(actions.shape[1]):
            tokens = torch.cat([tokens, slot], 1)
            step = self.llama(inputs_embeds=self._embedded(tokens, actions), use_cache=True, logits_to_keep=1)
            for number in range(layout.tokens):
                best, places = (step.logits[:, -1].float() / self.temperature).topk(min(self.top_k, layout.vocabulary))
                drawn = places.gather(1, torch.multinomial(best.softmax(-1), 1))
                tokens = torch.cat([tokens, drawn], 1)
                if number + 1 < layout.tokens:
                    step = self.llama(drawn, past_key_values=step.past_key_values, use_cache=True)
        later = tokens[:, layout.first_slot :].reshape(clips, -1, layout.per_frame)[:, :, 1:] - layout.codes
        return self.tokenizer.detokenize(context, later.clamp(0, layout.codes - 1))

    def _embedded(self, tokens: Tensor, actions: Tensor) -> Tensor:
        layout = self.layout
        slots = torch.arange(layout.first_slot, tokens.shape[1], layout.per_frame, device=tokens.device)
        embedded = self.llama.get_input_embeddings()(tokens)
        return embedded.index_add(1, slots, self.actions(actions[:, : len(slots)]).to(embedded.dtype))


def create(config: Config, batch: int, horizon: int, device: str) -> TorchWork:
    """Returns the work to time; sampling goes from pixels to pixels."""
    model = config.model
    clips = config.clips
    assert isinstance(model, IVideoGPTConfig)
    sampler = Sampler(model, clips)
    context = model.autoencoder.context_frames
    for network in (sampler.tokenizer, sampler.llama, sampler.actions):
        network.to(device)
    layout = sampler.layout
    tokens = torch.randint(0, layout.codes, (batch, layout.length(clips.frames)), device=device)
    actions = torch.randn(batch, max(horizon, clips.frames) - context, sampler.inputs, device=device)
    video = torch.rand(batch, clips.frames, 3, clips.image_size, clips.image_size, device=device)
    with torch.no_grad():
        codes = sampler.tokenizer.tokenize(video)
    return TorchWork(
        trained=(sampler.llama, sampler.actions),
        frozen=(sampler.tokenizer,),
        loss=lambda: sampler.loss(tokens, actions[:, : clips.frames - context]),
        sample=lambda: sampler.generate(video[:, :context], actions[:, : horizon - context]),
        sampled=horizon - context,
        encode=lambda: sampler.tokenizer.tokenize(video),
        decode=lambda: sampler.tokenizer.detokenize(*codes),
        frames=batch * clips.frames,
    )
