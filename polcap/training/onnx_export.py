"""ONNX export of networks for `formats/onnx.py`, with weights in fp16; reads the weights of exported models too.

Pictures may have any size. Weights are converted to fp32 when a model is opened, so that arithmetic is fp32.
"""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from polcap.errors import InputError
from polcap.formats import atomic
from polcap.formats.onnx import ENCODING
from polcap.stages.cues import CHANNELS
from polcap.training import main_network

OPSET = 17
UNSTATED = "NOASSERTION"  # SPDX name of a licence that nobody stated
NATIVE_SIZE = 256  # px of the longer side in inference, which uses sizes around it; larger than in training
_PREFIX, _HALF = "network.", ".half"  # of the names of stored weights
_NEWEST_FORMAT = 10  # version of the file format (ONNX: IR version); read by onnxruntime 1.20 and later


def export_main(network: main_network.MainNetwork, path: Path, facts: Mapping[str, str]) -> None:
    """Export the main network; `facts` joins its metadata (licence, version, training…)."""
    metadata = {
        "channels": ",".join(CHANNELS), "encoding": ENCODING, "native_size": str(NATIVE_SIZE),
        "size_multiple": str(main_network.SIZE_MULTIPLE),
        "outputs": "normal: unit, frame of each pixel's ray; depth: growing away from the camera, mean about 0, "
        "in radii of the disc that covers as many pixels as the object; diffuse, specular: linear; "
        "roughness: perceptual; sigma: expected normal error, degrees",
    }  # fmt: skip
    export_network(_OrderedOutputs(network), path, main_network.OUTPUTS, metadata | dict(facts))


def export_network(network: nn.Module, path: Path, outputs: tuple[str, ...], metadata: Mapping[str, str]) -> None:
    """Export a network from channels (1, N, H, W) to named maps, with the metadata that `formats/onnx.py` requires."""
    side = 2 * int(metadata["size_multiple"])  # of the picture by which the network is traced
    sample = torch.zeros(1, len(metadata["channels"].split(",")), side, side)
    with atomic.path(path) as temporary:
        torch.onnx.export(
            copy.deepcopy(network).cpu().float().eval(), (sample,), str(temporary),
            input_names=["channels"], output_names=list(outputs),
            dynamic_axes={name: {2: "height", 3: "width"} for name in ("channels", *outputs)},
            opset_version=OPSET, dynamo=False, do_constant_folding=False,  # folding would rename weights
            training=torch.onnx.TrainingMode.TRAINING,  # evaluation would store equal weights only once
        )  # fmt: skip
        graph = onnx.load(str(temporary))
        _store_as_fp16(graph)
        graph.ir_version = min(graph.ir_version, _NEWEST_FORMAT)
        helper.set_model_props(graph, dict(metadata))
        onnx.checker.check_model(graph)
        onnx.save(graph, str(temporary))


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the weights and metadata of a model that `export_main` wrote; weights by name, as the network's state.

    Raises InputError: the file does not exist or is no ONNX model.
    """
    try:
        graph = onnx.load(str(path))
    except (OSError, DecodeError) as error:
        raise InputError(f"{path}: cannot be read as an ONNX model ({error}); name one that polcap wrote") from error
    state = {
        tensor.name.removeprefix(_PREFIX).removesuffix(_HALF): torch.tensor(numpy_helper.to_array(tensor)).float()
        for tensor in graph.graph.initializer
        if tensor.name.startswith(_PREFIX)
    }
    return state, {entry.key: entry.value for entry in graph.metadata_props}


class _OrderedOutputs(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Wrapper that returns the network's maps as a tuple, in the order of OUTPUTS (ONNX needs an order)."""

    def __init__(self, network: main_network.MainNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        maps = self.network(x)
        return tuple(maps[name] for name in main_network.OUTPUTS)


def _store_as_fp16(graph: Any) -> None:
    """Store each fp32 weight tensor of an ONNX graph as fp16 with a Cast node; small ones, which save little, stay."""
    casts = []
    for tensor in graph.graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < 256:
            continue
        name, half = tensor.name, numpy_helper.to_array(tensor).astype(np.float16)
        tensor.CopyFrom(numpy_helper.from_array(half, name + _HALF))
        casts.append(helper.make_node("Cast", [name + _HALF], [name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.graph.node]
    del graph.graph.node[:]
    graph.graph.node.extend(nodes)
