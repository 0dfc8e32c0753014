"""The text model with a sentence encoder from a local folder; tiny random encoders of the published classes."""

from pathlib import Path
from typing import Any

import pytest
import torch
from model_folders import spec_of
from torch.testing import assert_close

from wm_nodes.config.load import load_config
from wm_nodes.config.schema import RunConfig
from wm_nodes.core.model_folder import ModelFolderError
from wm_nodes.policy_rl.pretraining import make_model
from wm_nodes.world_model import ActionModel, TextModel, Tokenizer, load_model_folder, save_model_folder
from wm_nodes.world_model.sentence_encoder import SentenceCondition, SentenceEncoder

WORDS = ("<pad>", "</s>", "<unk>", "push", "the", "cube", "sphere", "forward")
TEXTS = ["push the cube forward", "push the sphere"]


def make_encoder(folder: Path, kind: str, seed: int = 0) -> Path:
    """Write a random encoder of the class of MiniLM (bert) or T5 with a tokenizer of a few words."""
    transformers: Any = pytest.importorskip("transformers", reason="sentence encoders need requirements/video.txt")
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<pad>", eos_token="</s>", unk_token="<unk>"
    ).save_pretrained(folder)
    torch.manual_seed(seed)
    if kind == "bert":
        config = transformers.BertConfig(
            vocab_size=len(WORDS), hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=32
        )
        transformers.BertModel(config).save_pretrained(folder)
    else:
        config = transformers.T5Config(vocab_size=len(WORDS), d_model=16, d_kv=8, d_ff=32, num_layers=2, num_heads=2)
        transformers.T5EncoderModel(config).save_pretrained(folder)
    return folder


@pytest.fixture(params=["bert", "t5"])
def encoder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return make_encoder(tmp_path / "encoder", request.param)


def config_of(encoder: Path) -> RunConfig:
    return load_config("base", {
        "tokenizer.width": 16, "tokenizer.depth": 1, "tokenizer.latent_dim": 6, "world_model.width": 24,
        "world_model.depth": 1, "world_model.num_heads": 2, "world_model.text_encoder": str(encoder),
    })


def make_folder(folder: Path, encoder: Path) -> Path:
    config = config_of(encoder)
    torch.manual_seed(1)
    tokenizer = Tokenizer(config.tokenizer, 32, 32)
    sizes = {"num_tokens": tokenizer.num_tokens, "latent_dim": tokenizer.latent_dim, "num_tasks": 1}
    action = ActionModel(config.world_model, action_dim=3, state_dim=3, **sizes)
    text = TextModel(config.world_model, vocabulary=("unused",), **sizes)
    return save_model_folder(
        folder, tokenizer, action, text, config, spec=spec_of(config, tokenizer), tasks=("push_cube",), story={},
    )


def test_words_are_read_in_their_sentence_and_shorter_rows_are_masked(encoder: Path) -> None:
    condition = SentenceCondition(SentenceEncoder(encoder), 24)
    tokens, visible = condition(TEXTS)
    assert tokens.shape == (2, 5, 24) and visible is not None
    assert visible.tolist() == [[True] * 5, [True, True, True, False, True]]
    alone, nothing = condition(TEXTS[1:] * 3)
    assert alone.shape == (1, 4, 24) and nothing is None
    assert_close(alone[0, :3], tokens[1, :3])
    assert (tokens[0, :2] - tokens[1, :2]).abs().max() > 1e-3  # "push the" before other words
    assert set(dict(condition.named_parameters())) == {"project.weight", "project.bias", "null"}
    tokens.sum().backward()
    assert condition.project.weight.grad is not None


def test_a_model_folder_names_its_encoder_and_reads_as_it_did(encoder: Path, tmp_path: Path) -> None:
    models = load_model_folder(make_folder(tmp_path / "model", encoder))
    assert models.text is not None and isinstance(models.text.condition, SentenceCondition)
    assert models.manifest["world_model"]["text_encoder"] == str(encoder)
    assert models.manifest["text_encoder_sha256"] == SentenceEncoder(encoder).sha256
    again = load_model_folder(tmp_path / "model")
    assert again.text is not None and again.text.condition(TEXTS)[0].equal(models.text.condition(TEXTS)[0])


def test_a_model_without_its_encoder_or_with_another_one_is_one_clear_error(encoder: Path, tmp_path: Path) -> None:
    model = make_folder(tmp_path / "model", encoder)
    away = encoder.rename(tmp_path / "away")
    with pytest.raises(ModelFolderError, match=rf"^{encoder} \(world_model.text_encoder\) holds no config.json with"):
        load_model_folder(model)
    make_encoder(encoder, "bert", seed=1)
    with pytest.raises(ModelFolderError, match=rf"trained with another sentence encoder .* than {encoder} holds"):
        load_model_folder(model)
    (away / "config.json").write_text("{}")
    with pytest.raises(ModelFolderError, match=f"^{away} is no sentence encoder"):
        SentenceEncoder(away)


def test_a_missing_encoder_is_found_out_before_anything_is_collected(tmp_path: Path) -> None:
    config = load_config("smoke", {"world_model.text_encoder": str(tmp_path / "nothing")})
    with pytest.raises(ModelFolderError, match=r"nothing \(world_model.text_encoder\) holds no config.json"):
        make_model(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_loading_an_encoder_leaves_the_global_generator_as_it_was(encoder: Path) -> None:
    before = torch.get_rng_state()
    SentenceEncoder(encoder)
    assert torch.equal(torch.get_rng_state(), before)
