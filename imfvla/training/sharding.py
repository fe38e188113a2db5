"""Training in which every process holds a shard: `training.sharding=full`, by FSDP2 of PyTorch (arXiv 2304.11277).

- Sharded: parameters, gradients, AdamW's moments, the average of the weights.
- Whole in every process: buffers and activations; from the beginning of a loss to the end of its backward pass the
  weights (those of the encoder not between its passes) and the gradients, until they are scattered; the state while it
  is read. Process 0 gathers the state to write it.
- FSDP acts where the forward method of a unit is called. A loss calls that of the encoder, but bypasses those of
  the core and its blocks (keys and values of a context, a Jacobian-vector product), so that these would stay sharded.
  The units are therefore the encoder and everything else, and the loss itself is registered with FSDP as the latter's
  forward method.
- Files hold whole tensors under their usual names: a reader need not know how they were trained.
"""

import gc
import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.errors import UserError
from imfvla.training.options import FULL, NONE


def shard(module: nn.Module, device: torch.device, *, loss: str | None = None) -> None:
    """Leaves every process its shard of the parameters of `module`, a policy, which are equal in all of them.

    `loss` names the method before which they are gathered; after its backward pass every process has its shard of the
    gradients' mean over the processes. Raises UserError where a parameter cannot be divided.
    """
    if scalars := [name for name, parameter in module.named_parameters() if parameter.ndim == 0]:
        raise UserError(
            f"training.sharding={FULL} divides parameters along their first dimension, found none in "
            f"{', '.join(scalars)}: give them shape (1,), or set training.sharding={NONE}."
        )
    # Imported here: it takes a second, which only sharded training needs.
    from torch.distributed import get_world_size, init_device_mesh
    from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method

    for parameter in module.parameters():
        parameter.data = parameter.data.contiguous()  # FSDP takes no channels-last kernels
    mesh = init_device_mesh(device.type, (get_world_size(),))
    for unit in (getattr(module, "encoder", None), module):
        if unit is not None:
            fully_shard(unit, mesh=mesh)
    if loss is not None:
        register_fsdp_forward_method(module, loss)


def is_part(tensor: Tensor) -> bool:
    """Whether it is sharded, a DTensor; importing that class takes a second."""
    return hasattr(tensor, "full_tensor")


def whole(tensor: Tensor) -> Tensor:
    """The whole tensor. Where it is sharded, all processes must call this."""
    return tensor.full_tensor() if is_part(tensor) else tensor


def own_part(tensor: Tensor) -> Tensor:
    """What this process holds of a tensor: a view."""
    return tensor.to_local() if is_part(tensor) else tensor


def gathered(tensors: Mapping[str, Tensor], *, keep: bool) -> dict[str, Tensor]:
    """Whole tensors on the CPU, one after the other; none where a process only contributes its shards."""
    found = {}
    for name, tensor in tensors.items():
        all_of_it = whole(tensor.detach())
        if keep:
            found[name] = all_of_it.cpu()
    return found


def fill(tensor: Tensor, content: Tensor) -> Tensor:
    """Copies whole `content` into a tensor, or this process's shard of it into a sharded one; returns `tensor`."""
    if is_part(tensor):
        from torch.distributed.tensor import distribute_tensor

        layout: Any = tensor
        content = distribute_tensor(
            content.to(layout.device_mesh.device_type),
            layout.device_mesh,
            layout.placements,
            src_data_rank=None,  # each process has read all of it
        )
    return tensor.copy_(content)


def release(policy: nn.Module) -> None:
    """After a loss without a backward pass: shards the weights again. Leaves a whole policy unchanged."""
    if reset := getattr(policy, "reset_iter_state", None):
        reset()


def forget_layouts() -> None:
    """After the last sharded step: empties PyTorch's caches of layouts, each of which holds the process group."""
    if "torch.distributed.tensor" not in sys.modules:
        return
    from torch.distributed.tensor import _redistribute
    from torch.distributed.tensor._collective_utils import MeshTopoInfo
    from torch.distributed.tensor.debug import _clear_sharding_prop_cache

    _redistribute.clear_redistribute_planner_cache()
    _redistribute._gen_transform_infos.cache_clear()
    MeshTopoInfo.build_from_mesh.cache_clear()
    _clear_sharding_prop_cache()
    gc.collect()  # policy and mesh refer to each other
