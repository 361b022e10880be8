"""Read the authors' published `.pth` file without trusting it, and write it as our own checkpoint.

A `.pth` file is a zip of a pickle and raw tensor storages. The pickle is read by an unpickler that knows only
the names that such a file needs; each stands for an inert object that records its arguments and does nothing.
"""

from __future__ import annotations

import io
import json
import pickle
import pickletools
import reprlib
import zipfile
from collections import OrderedDict
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from mild_viz.checkpoint import Checkpoint, RobotInterface, check_checkpoint_target, save_checkpoint
from mild_viz.data.npz import ADMITTED as NUMPY_NAMES
from mild_viz.data.npz import MAX_BYTES
from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM, check_hmm
from mild_viz.latent.vae import VAE, make_vae
from mild_viz.robot.control.rules import DEFAULT_RULES
from mild_viz.robot.robots import ROBOTS
from mild_viz.settings import POINT_FEATURES, VARIANTS, WINDOW, choose
from mild_viz.trial import ARM_POINTS

ACTIONS = ("wave", "handshake", "rocket", "parachute")
"""Order of the authors' HMMs: the labels of the NuiSI file."""

LAYER_NAMES = {
    "_encoder.0": "encoder.0", "_encoder.2": "encoder.1", "post_mean": "posterior_mean",
    "post_logstd": "posterior_log_std", "_decoder.0": "decoder.0", "_decoder.2": "decoder.1", "_output": "output",
}  # fmt: skip
"""The authors' layer names -> ours. Their layer `latent` is not used by the forward pass."""

STORAGE_TYPES = {
    "FloatStorage": np.dtype("<f4"), "DoubleStorage": np.dtype("<f8"), "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"), "BoolStorage": np.dtype("?"), "BFloat16Storage": np.dtype("<u2"),
}  # fmt: skip


class Inert:
    """Stands for an object of the file: keeps what it was made from, does nothing."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state


def _inert(name: str) -> type[Inert]:
    return type(name, (Inert,), {})


ADMITTED: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("pbdlib_torch.hmm", "HMM"): _inert("HMM"),
    ("argparse", "Namespace"): _inert("Namespace"),
    **{key: _inert(key[1]) for key in NUMPY_NAMES},
    **{("torch", name): _inert(name) for name in STORAGE_TYPES},
}
"""The only names that the pickle may use, besides tensor reconstruction."""


class _Reader(pickle.Unpickler):
    """Unpickles a `.pth` archive with `ADMITTED` names only."""

    def __init__(self, archive: zipfile.ZipFile, root: str, file: Path) -> None:
        content = archive.read(f"{root}/data.pkl")
        super().__init__(io.BytesIO(content))
        # The unpickler makes room for every index up to the one that is named: one damaged byte can ask for 64 GB.
        for operation, argument, _ in pickletools.genops(content):
            if operation.name in ("PUT", "LONG_BINPUT") and not 0 <= (argument or 0) <= len(content):
                raise UserError(f"{file} is not a readable PyTorch archive: memo index {argument} is out of range")
        self._archive, self._root, self._file = archive, root, file

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._tensor
        try:
            return ADMITTED[module_name, global_name]
        except KeyError:
            raise UserError(
                f"{self._file} names {module_name}.{global_name}, which a published MILD checkpoint does not "
                "need: refused, and nothing of it was executed"
            ) from None

    def persistent_load(self, pid: Any) -> Any:
        return pid

    def _tensor(self, storage: Any, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
        """A tensor as an array; `storage` is ('storage', type, key, device, count)."""
        _, kind, key, _, _ = storage
        name = getattr(kind, "__name__", None)
        if name not in STORAGE_TYPES:
            raise UserError(
                f"{self._file}: tensor storage {key} is of type {reprlib.repr(kind)}; valid: {', '.join(STORAGE_TYPES)}"
            )
        data = np.frombuffer(self._archive.read(f"{self._root}/data/{key}"), STORAGE_TYPES[name])
        if name == "BFloat16Storage":  # the upper half of a float32
            data = (data.astype("<u4") << 16).view("<f4")
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if min(offset, *size, *stride, 0) < 0:
            raise UserError(f"{self._file}: a tensor of storage {key} has a negative offset, size or stride")
        # A stride of 0 repeats values: without the bound on the number, a short storage could fill the memory.
        if prod(size) > len(data) or (0 not in size and last >= len(data)):
            raise UserError(f"{self._file}: tensor storage {key} is shorter than its tensor")
        steps = [step * data.itemsize for step in stride]
        return np.lib.stride_tricks.as_strided(data[offset:], size, steps, writeable=False).copy()


def read_pth(file: Path) -> dict[str, Any]:
    """The content of a published file: dictionaries, arrays and inert stand-ins.

    Raises:
        UserError: if the file is missing, truncated, not such an archive, or names anything else.
    """
    try:
        if not file.is_file():
            raise UserError(f"{file} does not exist or is no file; expected a published `.pth` file")
        with zipfile.ZipFile(file) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                raise UserError(f"{file} unpacks to more than {MAX_BYTES >> 30} GiB; expected a smaller archive")
            root = archive.namelist()[0].split("/")[0]
            content = _Reader(archive, root, file).load()
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{file} cannot be read: {error.strerror or error}") from None
    except Exception as error:  # a damaged archive or pickle can raise nearly anything
        raise UserError(f"{file} is not a readable PyTorch archive: {type(error).__name__}: {error}") from None
    needed = ("model_h", "model_r", "ssm", "args_r", "args_h")
    if not isinstance(content, dict) or any(key not in content for key in needed):
        raise UserError(f"{file} is not a published MILD checkpoint: expected the entries {', '.join(needed)}")
    return content


def variant_of(arguments: dict[str, Any], where: str) -> str:
    """The variant that the file's own arguments describe (its name may say otherwise)."""
    number, covariance = arguments["variant"], arguments["cov_cond"]
    if type(number) is not int or number not in (1, 2, 3) or type(covariance) is not bool:
        raise UserError(
            f"{where}: variant is {reprlib.repr(number)} and cov_cond is {reprlib.repr(covariance)}; "
            "valid: 1, 2 or 3, and True or False"
        )
    return choose(where, "v1" if number == 1 else f"v{number}.{2 if covariance else 1}", list(VARIANTS))


def _vae(state: dict[str, np.ndarray], input_size: int, latent_size: int, where: str) -> VAE:
    tensors = {
        f"{ours}.{kind}": state[f"{theirs}.{kind}"]
        for theirs, ours in LAYER_NAMES.items()
        for kind in ("weight", "bias")
        if f"{theirs}.{kind}" in state
    }
    return make_vae(tensors, input_size, (40, 20), latent_size, where)


def _hmm(state: dict[str, Any], where: str) -> HMM:
    # Their M-step divides transition counts along the wrong axis, so rows sum to .94-1.06: normalise them.
    transition = state["_trans"].astype(np.float64)
    initial = state["_init_priors"].astype(np.float64)
    hmm = HMM(
        initial / initial.sum(),
        transition / transition.sum(1, keepdims=True),
        state["_mu"].astype(np.float64),
        state["_sigma"].astype(np.float64),
    )
    return check_hmm(hmm, where)


def import_published(file: Path, out: Path) -> Checkpoint:
    """Convert a published Pepper model to our format, and write it to the folder `out`.

    Raises:
        UserError: if the file is not such a model, or `out` already holds something else.
    """
    check_checkpoint_target(out)
    content, pepper = read_pth(file), ROBOTS["pepper"]
    try:
        arguments = content["args_r"].state
        variant = variant_of(arguments, f"{file}: args_r")
        n_joints, latent = int(arguments["num_joints"]), int(arguments["latent_dim"])
        if n_joints != len(pepper.joint_names):
            raise UserError(
                f"{file} drives {n_joints} joints; only Pepper models ({len(pepper.joint_names)}) can be imported"
            )
        human_vae = _vae(content["model_h"], WINDOW * POINT_FEATURES * len(ARM_POINTS), latent, f"{file}: model_h")
        robot_vae = _vae(content["model_r"], WINDOW * n_joints, latent, f"{file}: model_r")
        hmms = {a: _hmm(ssm.state, f"{file}: ssm {a}") for a, ssm in zip(ACTIONS, content["ssm"], strict=True)}
        recorded = {key: value for key, value in arguments.items() if isinstance(value, (str, int, float, bool))}
        json.dumps(recorded)  # a number of thousands of digits cannot be written
    except UserError:
        raise
    except Exception as error:  # its parts can be of any type and shape
        raise UserError(f"{file} is not a published MILD checkpoint: {type(error).__name__}: {error}") from None
    checkpoint = Checkpoint(
        path=out,
        name=out.name,
        dataset="nuisi",
        dataset_checksum="",
        human_vae=human_vae,
        hmms=hmms,
        robot_vaes={variant: robot_vae},
        robot=RobotInterface("pepper", pepper.joint_names, pepper.end_effector),
        contact_rules={action: DEFAULT_RULES[action] for action in hmms},
        training={
            "command": f"mild-viz import-published {file.name} --out {out.name}",
            "source": "the authors' published file",
            "arguments": recorded,
        },
    )
    readme = (
        f"# {out.name}\n\nThe authors' published model, read from `{file.name}`. By its own arguments it is variant "
        f"{variant} (`variant {arguments['variant']}`, `cov_cond {arguments['cov_cond']}`).\n"
    )
    return save_checkpoint(checkpoint, out, readme)
