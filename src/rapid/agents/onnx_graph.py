"""A graph of ONNX's standard operators under construction, written node by node.

Tracing gives a correct graph of three times as many nodes, and at batch 1 it is their number that takes the time.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from rapid.scenarios import NUM_ACTIONS, NUM_FEATURES

OPSET, IR_VERSION = 17, 8
Array = NDArray[np.float32]


class Graph:
    """Nodes and constants, in the order in which they were asked for, of a network that reads so many vehicles."""

    def __init__(self, onnx: Any, vehicles: int) -> None:
        self._onnx, self.nodes, self.constants = onnx, list[Any](), list[Any]()
        self.vehicles = vehicles

    def constant(self, value: Any, kind: type = np.float32) -> str:
        """Keep an array and return its name."""
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(value, kind, order="C"), name))
        return name

    def node(self, kind: str, *inputs: str | Array | float, outputs: int = 1, **attributes: Any) -> Any:
        """Add a node; inputs that are numbers become constants. Return its output's name, or a list of several."""
        names = [item if isinstance(item, str) else self.constant(item) for item in inputs]
        name = f"n{len(self.nodes)}"
        made = [f"{name}_{index}" for index in range(outputs)]
        # onnxruntime before 1.22 takes nodes without a name for one and the same when it fuses them.
        self.nodes.append(self._onnx.helper.make_node(kind, names, made, name, **attributes))
        return made[0] if outputs == 1 else made

    def reshape(self, value: str, *shape: int) -> str:
        """Return the value in another shape; -1 is what is left over."""
        return self.node("Reshape", value, self.constant(shape, np.int64))

    def cut(self, value: str, start: int, end: int, axis: int) -> str:
        """Return entries `start` to `end` along an axis."""
        bounds = [self.constant([number], np.int64) for number in (start, end, axis)]
        return self.node("Slice", value, *bounds)

    def number(self, condition: str) -> str:
        """Return 1 where a condition holds, else 0."""
        return self.node("Cast", condition, to=self._onnx.TensorProto.FLOAT)

    def linear(self, rows: str, layer: nn.Linear) -> str:
        """Return what the layer makes of rows."""
        return self.node("Gemm", rows, array(layer.weight).T, array(layer.bias))

    def norm(self, rows: str, layer: nn.LayerNorm) -> str:
        """Return the rows normalised."""
        return self.node("LayerNormalization", rows, array(layer.weight), array(layer.bias), axis=-1, epsilon=layer.eps)

    def model(self, state_size: int = 0) -> Any:
        """Return the `onnx.ModelProto` of the nodes so far, checked: from `obs` (B, V, F) to `q` (B, A).

        With a state of some size S it also reads `state` (B, S) and gives `next_state`. All of these are names that
        the nodes must use.
        """
        kind, onnx = self._onnx.TensorProto.FLOAT, self._onnx
        inputs, outputs = {"obs": (self.vehicles, NUM_FEATURES)}, {"q": (NUM_ACTIONS,)}
        if state_size:
            inputs, outputs = {**inputs, "state": (state_size,)}, {**outputs, "next_state": (state_size,)}
        given, made = (
            [onnx.helper.make_tensor_value_info(name, kind, ["batch", *shape]) for name, shape in side.items()]
            for side in (inputs, outputs)
        )
        model = onnx.helper.make_model(
            onnx.helper.make_graph(self.nodes, "rapid", given, made, self.constants),
            opset_imports=[onnx.helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="rapid",
        )
        onnx.checker.check_model(model, full_check=True)
        return model


def array(tensor: Tensor) -> Array:
    """Return a tensor's values."""
    return tensor.detach().cpu().numpy()
