"""Checkpoints in the layout of the transformers library: a folder, or a name on the Hugging Face hub.

Nothing is fetched unless what was asked for is a name there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from surgbench.errors import ConfigError
from surgbench.extras import missing, not_installed
from surgbench.files import sha256_file, sha256_text
from surgbench.syntax import parse_json

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
_SHARDS = f"{WEIGHTS}.index.json"
# What a checkpoint says it is, and the class that loads it.
MODELS = {"sam2_video": "Sam2VideoModel", "edgetam_video": "EdgeTamVideoModel"}
EXAMPLE = "facebook/sam2.1-hiera-tiny"
# As the hub takes them: an owner, and a name of letters, digits, '-', '_' and '.'.
_HUB_NAME = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*")


def local_folder(reference: str) -> Path | None:
    """The folder that a reference means; ``None`` where it is a name on the hub.

    A name is ``OWNER/NAME`` where neither such a folder is here nor one that is called as the owner.

    Raises:
        ConfigError: It is neither.
    """
    path = Path(reference).expanduser()
    if path.is_dir():
        return path
    if path.is_file():
        raise ConfigError(f"{path}: a file; expected a folder, which `surgbench convert sam2` makes of a .pt file")
    if _HUB_NAME.fullmatch(reference) and not path.parent.exists():
        return None
    raise ConfigError(f"{path}: no such folder; expected one with {CONFIG} and {WEIGHTS}, or a name like {EXAMPLE}")


def fetched_folder(name: str, revision: str) -> Path:
    """The folder of a checkpoint of the hub, downloaded unless it was before.

    Raises:
        ConfigError: There is none of that name and revision, or no way to it; one line.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(name, revision=revision, allow_patterns=[CONFIG, "*.safetensors", _SHARDS]))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError) as error:
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise ConfigError(f"{name}: cannot be fetched from the hub ({first})") from None


def weight_files(folder: Path) -> list[Path]:
    """The safetensors files of a checkpoint.

    Raises:
        ConfigError: There is none.
    """
    if (folder / WEIGHTS).is_file():
        return [folder / WEIGHTS]
    if (folder / _SHARDS).is_file():
        places = _read_json(folder / _SHARDS).get("weight_map")
        if isinstance(places, dict) and places:
            return [folder / str(name) for name in sorted(set(map(str, places.values())))]
    raise ConfigError(f"{folder / WEIGHTS}: no such file; expected the weights of a checkpoint")


def check_folder(folder: Path) -> str:
    """Look through a checkpoint without loading it.

    Returns:
        What it says it is, a key of ``MODELS``.

    Raises:
        ConfigError: A file is missing or damaged, or it is of another architecture; one line with the file.
    """
    path = folder / CONFIG
    kind = _read_json(path).get("model_type")
    if kind not in MODELS:
        valid = " or ".join(f"'{one}'" for one in MODELS)
        raise ConfigError(f"{path}: the checkpoint is of the architecture {kind!r}; expected {valid}")
    for weights in weight_files(folder):
        try:
            with safe_open(weights, framework="np"):
                pass
        except FileNotFoundError:
            raise ConfigError(f"{weights}: no such file") from None
        except (SafetensorError, OSError) as error:
            raise ConfigError(f"{weights}: damaged, or no safetensors file ({_line(error)})") from None
    return str(kind)


def weights_sha256(folder: Path) -> str:
    """Hex SHA-256 of a checkpoint's weights; of several files, of their hashes."""
    hashes = [_hash(path, path.stat().st_size, path.stat().st_mtime_ns) for path in weight_files(folder)]
    return hashes[0] if len(hashes) == 1 else sha256_text("".join(hashes))


@lru_cache(maxsize=8)
def _hash(path: Path, size: int, modified_ns: int) -> str:
    # The files are large, and are asked about by every instance.
    return sha256_file(path)


@lru_cache(maxsize=1)
def load_network(folder: Path, sha256: str, device: str, memory_frames: int | None) -> Any:
    """Load a checkpoint; views and sequences one after the other share it.

    Args:
        folder: It.
        sha256: Of its weights, so that others in the same place are loaded anew.
        device: ``cpu`` or ``cuda``.
        memory_frames: How many frames it remembers, the prompted one included; its own number unless told.

    Returns:
        The transformers model, in single precision, ready to be asked (``eval``).

    Raises:
        ConfigError: It is not what :func:`check_folder` lets pass, weights are missing, or unknown, or of another
            shape, or the checkpoint remembers fewer frames; one line.
    """
    import torch
    import transformers

    kind = check_folder(folder)
    config = _read_json(folder / CONFIG)
    backbone = (config.get("vision_config") or {}).get("backbone_config") or {}
    if backbone.get("model_type") == "timm_wrapper" and missing(("timm",)):
        raise ConfigError(f"{folder / CONFIG}: its image encoder is one of timm's, and {not_installed(['timm'])}")
    with _quietly(transformers):
        try:
            network, info = getattr(transformers, MODELS[kind]).from_pretrained(
                folder,
                local_files_only=True,
                use_safetensors=True,
                output_loading_info=True,
                ignore_mismatched_sizes=True,  # or the error does not say which
                dtype="float32",
            )
        except Exception as error:  # whatever a wrong value in the configuration leads to
            raise ConfigError(f"{folder}: cannot be loaded as {MODELS[kind]} ({_line(error)})") from None
    wrong = {
        name: f"is of shape {tuple(there)}, not {tuple(needed)}" for name, there, needed in info["mismatched_keys"]
    }
    wrong |= dict.fromkeys(info["unexpected_keys"], "is unknown") | dict.fromkeys(info["missing_keys"], "is missing")
    if wrong:
        first = min(wrong)
        raise ConfigError(f"{folder / WEIGHTS}: not the weights of what {CONFIG} describes: '{first}' {wrong[first]}")
    if memory_frames is not None:
        if memory_frames > network.num_maskmem:
            raise ConfigError(f"{folder}: remembers {network.num_maskmem} frames at most, not {memory_frames}")
        network.num_maskmem = memory_frames
    # In memory of its own: what lies in the file may be changed there, and the last digits of a sum depend on where its
    # terms lie.
    with torch.no_grad():
        for value in (*network.parameters(), *network.buffers()):
            value.data = value.data.to(device, copy=True)
    return network.eval().to(device)


@contextmanager
def _quietly(library: Any) -> Iterator[None]:
    """Without the library's progress bars and reports, which would go to standard error."""
    logging = library.utils.logging
    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = parse_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({(error.strerror or str(error)).lower()})") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must be an object, not {json.dumps(content)[:40]}")
    return content


def _line(error: Exception) -> str:
    """The first line of what an error says."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
