"""Number type of the networks' arithmetic: bfloat16 where the machine has it, else float32.

bfloat16 doubles the speed of a GPU, and of a CPU with bfloat16 instructions. On other CPUs it is emulated and a dozen
times slower.
"""

from contextlib import AbstractContextManager
from functools import cache

import torch


@cache
def compute_type(device: torch.device) -> torch.dtype:
    """The fastest type for convolutions and matrix products."""
    if device.type != "cpu":
        return torch.bfloat16
    return torch.bfloat16 if torch.ops.mkldnn._is_mkldnn_bf16_supported() else torch.float32


def autocast(device: torch.device) -> AbstractContextManager[None]:
    """Context in which torch computes in `compute_type`."""
    half = compute_type(device) == torch.bfloat16
    # no cache of converted weights: threads would share it
    block: AbstractContextManager[None] = torch.autocast(device.type, torch.bfloat16, enabled=half, cache_enabled=False)
    return block
