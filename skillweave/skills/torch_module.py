"""PyTorch modules as policies."""

from __future__ import annotations

import copy
import io
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, overload

import numpy as np
from gymnasium import Space

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, shortened, suggest
from skillweave._internal.notices import notice
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.core import Array, Turn
from skillweave.policies.mapped import invoke, of_model, parted, rows_first, states_of
from skillweave.policies.untrusted import checksum, read_file
from skillweave.schema import fitted
from skillweave.skills.foreign_policy import made_up, qualified
from skillweave.skills.learnable import PLAIN_PPO, Learnable, layers_of, no_mapping
from skillweave.skills.mapped import MappedPolicy, hidden_state
from skillweave.skills.mapping import PolicyMapping, mapping_of

if TYPE_CHECKING:
    from torch import nn


class TorchPolicy(MappedPolicy):
    """A module whose forward takes observations and returns logits or actions.

    Args:
        file: the file that it was loaded from, if any.
        content: of that file, from which copies load it again, as it cannot be pickled.
    """

    kind = "torch"
    suffix = ".safetensors"

    def __init__(
        self,
        module: nn.Module,
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
        file: Path | None = None,
        content: bytes = b"",
    ) -> None:
        name = str(file) if file else f"module {type(module).__name__}"
        super().__init__(name, observation_space, action_space, mapping)
        self.module: Any = module
        self.data = content
        self.label = qualified(type(module))
        """Its name in runs."""
        self.origin = {"file": name, "sha256": checksum(content)} if file else {}
        """The file's path and checksum; {}: it was made in memory."""
        self._first = _buffers_of(module, self.mapping.state, name)
        self.buffers = tuple(self._first)
        """The names of the buffers in which its recurrent state lies; (): forward takes it."""

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        if self.data:
            del state["module"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.data:
            self.module = _module_in(self.data, self.name)

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy in evaluation mode, independent of later changes of the module."""
        bound = super().bind(observation_space, action_space, who)
        if not self.data:  # a file's is its own, and one of torch.export has a fixed mode
            bound.module = self._own_module()
        return bound

    def _own_module(self) -> nn.Module:
        module: nn.Module = copy.deepcopy(self.module).eval()
        return module

    def twin(self) -> Self:
        """Return a copy with a module of its own."""
        twin = copy.copy(self)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about exported programs
            twin.module = copy.deepcopy(self.module)
        return twin

    def tensors(self) -> dict[str, Any]:
        """Return copies of the buffers of its module, and of tensors in attributes, by name."""
        from torch import Tensor

        found: dict[str, Any] = dict(self.module.named_buffers())
        for path, part in self.module.named_modules():
            for name, value in vars(part).items():
                several = value if isinstance(value, tuple | list) else (value,)
                inner = {f"{path}.{name}".lstrip("."): x for x in several if isinstance(x, Tensor)}
                found |= inner
        declared = set(self.buffers)
        return {
            name: x.detach().cpu().numpy().copy()
            for name, x in found.items()
            if name not in declared
        }

    def _failure(self, error: BaseException) -> PolicyError:
        """Return the error of a call that failed, or that a state of one environment is kept."""
        twin, before = self.twin(), self.tensors()
        twin._failure = super()._failure  # type: ignore[method-assign]
        with suppress(Exception):
            twin.outputs(made_up(self.observation_space, 1))
        after = twin.tensors()
        if written := [
            k for k, x in after.items() if k not in before or not np.array_equal(x, before[k])
        ]:
            return PolicyError(f"{self._who} {hidden_state([*self.buffers, *written])}")
        return super()._failure(error)

    @property
    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """The declared shapes of its state, in float64, which holds any module's."""
        if self.buffers:
            known = dict(self.module.named_buffers())
            return [(tuple(known[name].shape), np.float64) for name in self.buffers]
        return states_of(self.mapping.state)

    @property
    def first_states(self) -> Sequence[Array | None]:
        """The values that its recurrent state starts with; None: zeros."""
        return [*self._first.values()] if self.buffers else super().first_states

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Array, Sequence[Array]]:
        """Call the module."""
        import torch

        from skillweave.spaces import unpack

        mapping = self.mapping
        given = dict[str, Any](inputs)
        if mapping.sees is None:
            given[""] = unpack(self.observation_space, given[""])
        weights = [*self.module.parameters(), *self.module.buffers()]
        device = weights[0].device if weights else None
        dtype = next((x.dtype for x in weights if x.is_floating_point()), torch.float32)
        given = {name: _tensors(x, device, dtype) for name, x in given.items()}
        if self.buffers:
            return self._call_rows(given, state)
        before = [_tensors(x, device, dtype) for x in of_model(state, mapping.state)]
        try:
            with torch.inference_mode():
                value = invoke(self.module, given, before, mapping.single_state)
        except (Exception, SystemExit) as error:
            raise self._failure(error) from error
        output, after = parted(value, mapping, self._who)
        for part, what in ((output, "one tensor"), *((x, "tensors as its state") for x in after)):
            if not isinstance(part, torch.Tensor):
                raise PolicyError(
                    f"{self._who} returned a {type(part).__name__}; forward must return {what}"
                )
        output = output.float() if output.is_floating_point() else output
        arrays = [x.to(torch.float64).cpu().numpy() for x in after]
        return output.cpu().numpy(), rows_first(arrays, mapping.state, self._who)

    def _call_rows(
        self, given: dict[str, Any], state: tuple[Array, ...]
    ) -> tuple[Array, Sequence[Array]]:
        """Call the module for one environment after the other, with its state in its buffers."""
        import torch
        from torch.utils import _pytree as pytree

        known = dict(self.module.named_buffers())
        own = [known[name] for name in self.buffers]
        outputs, after = list[Array](), list[list[Array]]()
        # No inference_mode: its tensors cannot be written to afterwards.
        with torch.no_grad():
            for i in range(len(state[0])):
                for buffer, value in zip(own, state, strict=True):
                    buffer.copy_(torch.from_numpy(np.asarray(value[i])))
                row = pytree.tree_map(lambda x, i=i: x[i : i + 1], given)
                try:
                    output = invoke(self.module, row, (), False)
                except (Exception, SystemExit) as error:
                    raise self._failure(error) from error
                if not isinstance(output, torch.Tensor):
                    raise PolicyError(
                        f"{self._who} returned a {type(output).__name__}; forward must return one "
                        "tensor"
                    )
                output = output.float() if output.is_floating_point() else output
                outputs.append(output.cpu().numpy().copy())
                # A module may have put another tensor in the place of a buffer.
                now = dict(self.module.named_buffers())
                after.append([now[k].to(torch.float64).cpu().numpy().copy() for k in self.buffers])
        return np.concatenate(outputs), [np.stack(x) for x in zip(*after, strict=True)]

    def normalized(self) -> dict[str, tuple[Array, Array]]:
        """Return the mean and deviation of a submodule that normalizes, as rsl_rl writes it.

        It has the buffers ``_mean`` and ``_std``, and divides by the deviation and 0.01.
        """
        for part in self.module.modules():
            buffers = dict(part.named_buffers(recurse=False))
            if {"_mean", "_std"} <= buffers.keys():
                mean, deviation = (
                    buffers[k].cpu().numpy().astype(float) for k in ("_mean", "_std")
                )
                return {
                    "": (
                        mean.reshape(-1),
                        deviation.reshape(-1) + float(getattr(part, "eps", 0.01)),
                    )
                }
        return super().normalized()

    def source(self) -> dict[str, Any]:
        """Return the module's class, the checksum of its weights or its file, and the mapping."""
        return super().source() | {"name": self.label} | self.origin

    def content(self) -> bytes | None:
        """Return its weights as a safetensors file; None for a file, which can run code.

        Raises:
            PolicyError: it has state that is not a tensor.
        """
        if self.origin:
            return None
        import safetensors.torch
        from torch import Tensor

        state = self.module.state_dict()
        for name, value in state.items():
            if not isinstance(value, Tensor):
                raise PolicyError(
                    f"{self._who}: its state {name!r} is a {type(value).__name__}, no tensor"
                )
        # Clones: modules may share tensors, which the format does not support.
        copies = {name: value.detach().cpu().clone() for name, value in state.items()}
        for name in set(self.buffers) & copies.keys():  # where it acted last is no weight
            copies[name].zero_()
        return safetensors.torch.save(copies)

    def restored(self, content: bytes) -> Self:
        """Return a copy with these weights.

        Raises:
            RunError: the weights have other names or shapes.
        """
        import safetensors
        import safetensors.torch
        import torch

        policy = copy.copy(self)
        module = self._own_module()
        try:
            with torch.device("cpu"):  # the user may have changed the default device
                weights = safetensors.torch.load(content)
            module.load_state_dict(weights)
        except (RuntimeError, safetensors.SafetensorError) as error:
            raise RunError(
                f"{self._who}: the weights in the run do not fit it: {shortened(str(error))}"
            ) from error
        policy.module = module
        return policy


@overload
def from_torch(
    module: nn.Module | str | Path,
    *,
    trust: bool = False,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: int = 1,
    chunk: int | None = None,
    state: Any = None,
    anew: Any = (),
    entry: int = 0,
    observation_space: Any = None,
    action_space: Any = None,
    learn: Literal[False] = False,
) -> TorchPolicy: ...


@overload
def from_torch(
    module: nn.Module,
    *,
    observation_space: Any = None,
    action_space: Any = None,
    learn: Literal[True],
) -> Learnable: ...


@checked_names
def from_torch(
    module: nn.Module | str | Path,
    *,
    trust: bool = False,
    sees: Any = None,
    goal: Any = None,
    acts: Any = None,
    every: int = 1,
    chunk: int | None = None,
    state: Any = None,
    anew: Any = (),
    entry: int = 0,
    observation_space: Any = None,
    action_space: Any = None,
    learn: bool = False,
) -> TorchPolicy | Learnable:
    """Return a PyTorch module as a skill's policy; a skill takes the bare module too.

    ``forward`` receives observations (n, *obs_shape) of the type of its weights (float32 without
    weights), images unscaled, for a Dict or Tuple a dict or tuple of such; with ``sees``, its
    inputs. It returns logits for Discrete (concatenated for MultiDiscrete, one for each bit of
    MultiBinary), actions for Box (clipped to its bounds); whole numbers are always actions. With
    ``state``, it takes that as its second argument (by the name ``state``, where the inputs have
    names), and returns the output and the next state.

    Its weights are copied into the run; loading the run replaces the weights of the recipe's module
    by them. A file is recorded by its path and checksum, without a copy.

    With ``learn=True`` the skill is trained by ``PPO``, and begins with the module, a
    ``Sequential`` of linear layers with one kind of nonlinearity between them; the critic and the
    deviation of actions start afresh, so the critic learns alone in the first five updates, at most
    a tenth of the steps.

    Args:
        module: acts in evaluation mode, as a copy made when training starts; or a file of
            TorchScript (``torch.jit.save``) or of an exported program (``torch.export.save``).
        trust: True if you trust the author of the file: opening it may run any code in it.
        sees: the parts of the observation that the module takes, a list, or one for each of its
            arguments by name; see ``from_onnx``.
        goal: the value of ``Goal()`` in ``sees``; see ``from_onnx``.
        acts: the meaning of the output, ``Acts(...)``; None: it is the action.
        every: each action is held for this number of steps.
        chunk: the number of actions that are used of each output (n, H, ...).
        state: the shape of a recurrent state, None as the axis of the environments: (1, None, 64);
            or a list of shapes, for a tuple of tensors; or the names of the buffers in which a
            module keeps it, ("hidden_state", "cell_state"). It starts with zeros; a buffer with
            another value where that is given, {"phase": 1.0}.
        anew: what begins anew where the skill is called again at once: "state", "last_action",
            "held" (of ``every`` and ``chunk``), "elapsed" (clocks, tables and ``call``; with
            ``every`` name "held", too), "history", or several. The rest goes on; after another
            skill's call all begins anew.
        entry: the step at which time starts where the skill takes over, of ``Elapsed``, ``Table``
            and ``call`` in ``sees``: a motion is entered in its middle.
        observation_space: None: the environment's.
        action_space: None: the environment's.
        learn: the skill learns on from the module.

    Returns:
        The policy, for a skill's ``policy`` or ``evaluate``; with ``learn=True`` for a skill's
        ``policy`` or ``start_from``.

    Raises:
        DeclarationError: it is not an instance of a module, or an argument is wrong.
        PolicyError: the file is not trusted, or holds no module; or the module cannot learn on.
        RunError: the file does not exist.
    """
    mapping = mapping_of(
        "from_torch()", sees, goal, acts, every, chunk, state, anew=anew, entry=entry
    )
    fitted(bool, learn, "from_torch(): learn")
    if learn and mapping != PolicyMapping():
        raise DeclarationError(
            no_mapping("from_torch(learn=True): the module", "sees, acts and the like")
        )
    if learn and isinstance(module, str | Path):
        raise DeclarationError("from_torch(learn=True) takes a module made of its class, no file")
    if isinstance(module, str | Path):
        file = Path(module)
        if trust is not True:
            raise PolicyError(
                f"{file} was not opened: TorchScript and exported programs can run code on your "
                f"machine. If you trust its author: from_torch({str(file)!r}, trust=True)"
            )
        content = read_file(file)
        loaded = _module_in(content, str(file))
        return TorchPolicy(loaded, observation_space, action_space, mapping, file, content)
    if isinstance(module, type) or not hasattr(module, "state_dict"):
        raise DeclarationError(f"from_torch takes a module made of its class, not {short(module)}")
    if learn:
        who = f"module {type(module).__name__}"
        return Learnable(
            who,
            "PPO",
            {"actor": layers_of([module], who)},
            env_units=True,
            observation_space=observation_space,
            action_space=action_space,
            settings=PLAIN_PPO,
        )
    return TorchPolicy(module, observation_space, action_space, mapping)


def _buffers_of(module: nn.Module, state: Any, name: str) -> dict[str, Array | None]:
    """Return the first values of the buffers in which a module keeps its state; None: zeros.

    Args:
        state: as declared; {} is returned where it names no buffers.
        name: of the module, for messages.

    Raises:
        PolicyError: the module has no such buffer, or of another size.
    """
    if not state or not isinstance(state[0][0], str):
        return {}
    firsts = {name: first[0] if first else None for name, *first in state}
    known = dict(module.named_buffers())
    found: dict[str, Array | None] = {}
    for buffer, first in firsts.items():
        if buffer not in known:
            raise PolicyError(
                f"{name} has no buffer {buffer!r} (state){suggest(buffer, known)}: it has "
                f"{', '.join(known)[:300] or 'none'}"
            )
        now = known[buffer].detach().cpu().numpy()
        if first is None:
            if now.any():
                notice(
                    f"{name}: its buffer {buffer!r} holds {short(now.reshape(-1).tolist(), 80)}, "
                    "but a state starts with zeros: give its first value where that is meant, "
                    f"state={{{buffer!r}: ...}}, or zeros, to start with these"
                )
            found[buffer] = None
            continue
        if np.ndim(first) and np.size(first) != now.size:
            raise PolicyError(
                f"{name}: the first value of {buffer!r} (state) has {np.size(first)} numbers, but "
                f"the buffer has the shape {now.shape}"
            )
        several = bool(np.ndim(first))
        found[buffer] = np.reshape(first, now.shape) if several else np.full(now.shape, first)
    return found


def _module_in(content: bytes, file: str) -> nn.Module:
    """Return the module in a file of TorchScript, or of an exported program.

    Raises:
        PolicyError: it holds neither.
    """
    import torch

    wrong = (
        f"{file} holds neither TorchScript nor an exported program. Make the module, load its "
        "weights, and give the module: from_torch(module)"
    )
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            names = archive.namelist()
    except zipfile.BadZipFile as error:
        raise PolicyError(wrong) from error
    script = any("/code/" in f"/{name}" for name in names)
    exported = any(
        f"/{name}".endswith(("/archive_format", "/serialized_exported_program.json"))
        for name in names
    )
    if not script and not exported:
        raise PolicyError(wrong)
    try:
        if exported:
            return _program_of(torch.export.load(io.BytesIO(content)))
        module: nn.Module = torch.jit.load(io.BytesIO(content), map_location="cpu")
        return module.eval()
    except Exception as error:  # torch's own errors have no common class
        raise PolicyError(f"{file} could not be opened: {shortened(str(error))}") from error


def _program_of(program: Any) -> nn.Module:
    """Return an exported program as a module that takes rows, and inputs by name or position.

    A program that was exported for one row is called once for each.
    """
    import torch
    from torch.utils import _pytree as pytree

    class Program(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inner = program.module()
            wanted = [x for x in program.graph_signature.user_inputs if isinstance(x, str)]
            example = program.example_inputs
            by_name = 0 if example is None else len(example[1])
            self.names = wanted[: len(wanted) - by_name]
            nodes = {node.name: node for node in program.graph.nodes}
            self.single = all(nodes[name].meta["val"].shape[:1] == (1,) for name in self.names)

        def forward(self, *given: Any, **named: Any) -> Any:
            """Call the exported program, row by row where it takes one row at a time."""
            given = (*given, *(named.pop(name) for name in self.names if name in named))
            if not self.single or len(given[0]) == 1:
                return self.inner(*given, **named)
            rows = [
                self.inner(*(x[i : i + 1] for x in given), **named) for i in range(len(given[0]))
            ]
            leaves = [pytree.tree_leaves(row) for row in rows]
            joined = [torch.cat(x) for x in zip(*leaves, strict=True)]
            return pytree.tree_unflatten(joined, pytree.tree_structure(rows[0]))

    return Program()


def _tensors(obs: Any, device: Any, dtype: Any) -> Any:
    """Return observations as tensors for a user's module."""
    import torch

    if isinstance(obs, dict):
        return {name: _tensors(part, device, dtype) for name, part in obs.items()}
    if isinstance(obs, tuple):
        return tuple(_tensors(part, device, dtype) for part in obs)
    return torch.tensor(obs, dtype=dtype, device=device)
