"""A small InternVL with random weights and a tokenizer of single bytes, as a local folder."""

from pathlib import Path

import tokenizers
import torch
import transformers

_TEMPLATE = (
    "{% for message in messages %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<IMG_CONTEXT>{% else %}{{ part['text'] }}{% endif %}"
    "{% endfor %}{% endfor %}"
)
_NAMES = {
    "start_image_token": "<img>",
    "end_image_token": "</img>",
    "context_image_token": "<IMG_CONTEXT>",
    "video_token": "<video>",
}


def save_small(folder: Path) -> Path:
    """Pictures are 28 pixels wide and one token each."""
    torch.manual_seed(0)
    letters = sorted(tokenizers.pre_tokenizers.ByteLevel.alphabet())
    bytewise = tokenizers.Tokenizer(tokenizers.models.BPE({letter: i for i, letter in enumerate(letters)}, []))
    bytewise.pre_tokenizer = tokenizers.pre_tokenizers.ByteLevel(add_prefix_space=False)
    bytewise.decoder = tokenizers.decoders.ByteLevel()
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_object=bytewise, eos_token="<eos>", pad_token="<eos>", extra_special_tokens=_NAMES
    )
    size = {"height": 28, "width": 28}
    transformers.InternVLProcessor(
        image_processor=transformers.GotOcr2ImageProcessor(size=size),
        tokenizer=tokenizer,
        video_processor=transformers.InternVLVideoProcessor(size=size),
        image_seq_length=1,
        chat_template=_TEMPLATE,
    ).save_pretrained(folder)
    layers = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    ends = {"bos_token_id": None, "eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id}
    config = transformers.InternVLConfig(
        vision_config=layers | {"image_size": [28, 28], "patch_size": [14, 14]},
        text_config=layers | ends | {"model_type": "qwen2", "vocab_size": len(tokenizer), "num_key_value_heads": 1},
        image_token_id=tokenizer.context_image_token_id,
        image_seq_length=1,
    )
    transformers.InternVLForConditionalGeneration(config).save_pretrained(folder)
    return folder
