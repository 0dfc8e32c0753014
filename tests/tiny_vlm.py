"""A vision-language model small enough to make on the spot, for servers that we did not write.

Its towers are random and see the images, but its weights are set so that the next token depends on the last one alone:
after a prompt it says `answer`, then stops. So what a real server does with a request can be told exactly.
"""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

START_S = 120
IMAGE_PX, PATCH_PX = 16, 8
TEMPLATE = (
    "{% for m in messages %}{{ m['role'] }}: {% if m['content'] is string %}{{ m['content'] }}{% else %}"
    "{% for c in m['content'] %}{% if c['type'] == 'image' %}<image>{% elif c['type'] == 'text' %}{{ c['text'] }}"
    "{% endif %}{% endfor %}{% endif %}\n{% endfor %}{% if add_generation_prompt %}<answer>{% endif %}"
)


def save_tiny_vlm(folder: Path, answer: str) -> None:
    """Write a LLaVA model with tokenizer, processor and chat template that a server loads from the folder."""
    import torch
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers
    from transformers import CLIPVisionConfig, LlamaConfig, LlavaConfig, LlavaForConditionalGeneration, LlavaProcessor
    from transformers import PreTrainedTokenizerFast as FastTokenizer
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    alphabet = pre_tokenizers.ByteLevel.alphabet()
    special = ["<pad>", "<s>", "</s>", "<image>", "<answer>"]
    tokens = Tokenizer(models.BPE())
    tokens.pre_tokenizer, tokens.decoder = pre_tokenizers.ByteLevel(add_prefix_space=False), decoders.ByteLevel()
    tokens.train_from_iterator(
        ["judge the clip"], trainers.BpeTrainer(vocab_size=300, special_tokens=special, initial_alphabet=alphabet)
    )
    tokens.add_tokens([AddedToken(answer, normalized=False)])
    tokenizer = FastTokenizer(
        tokenizer_object=tokens, pad_token="<pad>", bos_token="<s>", eos_token="</s>",
        extra_special_tokens={"image_token": "<image>"},
    )
    pad, bos, eos, image, ask, said = tokenizer.convert_tokens_to_ids([*special, answer])
    processor = LlavaProcessor(
        image_processor=CLIPImageProcessorPil(
            size={"shortest_edge": IMAGE_PX}, crop_size={"height": IMAGE_PX, "width": IMAGE_PX}
        ),
        tokenizer=tokenizer, patch_size=PATCH_PX, vision_feature_select_strategy="default", chat_template=TEMPLATE,
        num_additional_image_tokens=1,
    )
    torch.manual_seed(0)
    vision = CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=IMAGE_PX,
        patch_size=PATCH_PX, projection_dim=16,
    )
    text = LlamaConfig(
        vocab_size=len(tokenizer), hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=2,
        num_key_value_heads=2, max_position_embeddings=16384, bos_token_id=bos, eos_token_id=eos, pad_token_id=pad,
        tie_word_embeddings=False,
    )
    model = LlavaForConditionalGeneration(
        LlavaConfig(vision_config=vision, text_config=text, image_token_index=image, tie_word_embeddings=False)
    )
    model.generation_config.eos_token_id, model.generation_config.pad_token_id = eos, pad
    with torch.no_grad():
        for layer in model.model.language_model.layers:  # nothing is added to the residual stream
            layer.self_attn.o_proj.weight.zero_()
            layer.mlp.down_proj.weight.zero_()
        known, head = model.get_input_embeddings().weight, model.lm_head.weight
        head.zero_()
        head[said], head[eos] = 100 * known[ask], 100 * known[said]
    model.save_pretrained(folder)
    processor.save_pretrained(folder)


@contextmanager
def transformers_serve(model: Path) -> Iterator[str]:
    """`transformers serve` with this model on a free port; yields its base URL."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    hub = model / "hub"
    hub.mkdir(exist_ok=True)
    log = model / "serve.log"
    command = [
        sys.executable, "-m", "transformers.cli.transformers", "serve", str(model), "--host", "127.0.0.1",
        "--port", str(port), "--device", "cpu", "--dtype", "float32",
    ]
    settings = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HUB_CACHE": str(hub), "OMP_NUM_THREADS": "1"}
    with log.open("w", encoding="utf-8") as out:
        server = subprocess.Popen(command, env=settings, stdout=out, stderr=out)
    try:
        for _ in range(START_S):
            try:
                urlopen(f"http://127.0.0.1:{port}/health", timeout=5).close()
                break
            except (URLError, ConnectionError):
                if server.poll() is not None:
                    break
                time.sleep(1)
        else:
            raise TimeoutError(f"transformers serve is not up after {START_S} s:\n{log.read_text('utf-8')[-2000:]}")
        if server.poll() is not None:
            raise RuntimeError(f"transformers serve ended with {server.returncode}:\n{log.read_text('utf-8')[-2000:]}")
        yield f"http://127.0.0.1:{port}/v1"
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
