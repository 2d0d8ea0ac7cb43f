"""A policy as two ONNX graphs: one reads the prompt, the other takes a step with the key-value cache.

The graphs compute what ``mgpo_jax.transformer`` does, for a policy with the linear encoder and discrete
actions. They handle a single episode. The cache grows with every step: its ``keys``, ``values`` and
``mask`` have an axis S of the tokens so far, whose length tells the graph the timestep.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
from flax.traverse_util import flatten_dict
from onnx import TensorProto, helper, numpy_helper

from mgpo_jax.network_configs import OBS_LIMIT, TransformerConfig
from mgpo_jax.policy import LoadedPolicy

OPSET, IR_VERSION = 17, 8  # the first with LayerNormalization; older runtimes support them
EPSILON = 1e-6  # default of flax's LayerNorm
HIDDEN = -1e9  # attention score of a key that is not visible


class Graph:
    """An ONNX graph under construction: its nodes and weights."""

    def __init__(self, policy: LoadedPolicy) -> None:
        self.config: TransformerConfig = policy.config
        self.weights = flatten_dict(policy.params["params"], sep="/")
        self.nodes: list[Any] = []
        self.tensors: dict[str, Any] = {}

    def __call__(self, kind: str, *inputs: str, num: int = 1, **attributes: Any) -> Any:
        """Add a node; returns the name of its output, or the names of all ``num`` outputs."""
        outputs = [f"{kind.lower()}_{len(self.nodes)}_{i}" for i in range(num)]
        self.nodes.append(helper.make_node(kind, list(inputs), outputs, **attributes))
        return outputs[0] if num == 1 else outputs

    def named(self, kind: str, *inputs: str, to: str, **attributes: Any) -> None:
        """Add a node whose output is an output ``to`` of the graph."""
        self.nodes.append(helper.make_node(kind, list(inputs), [to], **attributes))

    def constant(self, array: Any, dtype: Any = np.int64) -> str:
        """Add a constant, unless there is an equal one; returns its name."""
        array = np.asarray(array, dtype)
        name = f"constant_{array.dtype}_{list(array.shape)}_{array.ravel().tolist()}"
        self.tensors[name] = numpy_helper.from_array(array, name)
        return name

    def weight(self, name: str) -> str:
        """Add an array of weights by its name in the policy; returns the name."""
        if name not in self.tensors:
            array = np.asarray(self.weights[name], np.float32)
            self.tensors[name] = numpy_helper.from_array(array, name)
        return name

    def dense(self, x: str, name: str) -> str:
        product = self("MatMul", x, self.weight(f"{name}/kernel"))
        return self("Add", product, self.weight(f"{name}/bias"))

    def norm(self, x: str, name: str) -> str:
        parts = self.weight(f"{name}/scale"), self.weight(f"{name}/bias")
        return self("LayerNormalization", x, *parts, axis=-1, epsilon=EPSILON)

    def model(self, name: str, inputs: Any, outputs: Any, facts: Mapping[str, str]) -> Any:
        """The finished and checked model."""
        made = helper.make_graph(self.nodes, name, inputs, outputs, list(self.tensors.values()))
        model = helper.make_model(
            made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
        )
        helper.set_model_props(model, dict(facts))
        onnx.checker.check_model(model, full_check=True)
        return model


def prefill_graph(policy: LoadedPolicy, facts: Mapping[str, str]) -> Any:
    """The model that reads a prompt and the first observation.

    Inputs ``goals [P, G]``, ``prompt_mask [P]`` and ``obs``; outputs ``logits [A]``,
    ``next_action``, the greedy one, and the cache ``present_keys``, ``present_values``, ``present_mask``.
    """
    graph, config = Graph(policy), policy.config
    tokens = graph.dense("goals", "embed_goal")
    if config.prompt_order:
        tokens = graph("Add", tokens, graph.weight("embed_slot"))
    first = graph("Add", _obs_token(graph), _time(graph, graph.constant([0])))
    x = graph("Concat", tokens, first, axis=0)
    num = config.max_prompt_length + 1
    mask = graph("Concat", "prompt_mask", graph.constant([True], bool), axis=0)
    visible = graph("And", mask, graph.constant(np.tri(num, dtype=bool), bool))
    _transform(graph, x, visible, None)
    graph.named("Identity", mask, to="present_mask")
    inputs = [
        _value("goals", "FLOAT", [config.max_prompt_length, config.goal_dim]),
        _value("prompt_mask", "BOOL", [config.max_prompt_length]),
        _value("obs", "FLOAT", config.obs_shape),
    ]
    return graph.model("prefill", inputs, _outputs(config, num), facts)


def step_graph(policy: LoadedPolicy, facts: Mapping[str, str]) -> Any:
    """The model of one step, which reads the previous action and the observation after it.

    Inputs ``action``, ``obs`` and the cache ``past_keys``, ``past_values``, ``past_mask``; outputs
    ``logits [A]``, ``next_action``, the greedy one, and the cache with the tokens of this step.
    """
    graph, config = Graph(policy), policy.config
    stride, slots = config.tokens_per_step, config.max_prompt_length
    # There are stride * t - (stride - 1) tokens of t steps, up to the last observation.
    seen = graph("Sub", graph("Shape", "past_mask"), graph.constant([slots - stride + 1]))
    time = graph("Div", seen, graph.constant([stride]))
    embedded = graph.dense(_one_hot(graph), "embed_action")
    observed = graph("Add", _obs_token(graph), _time(graph, time))
    if stride == 1:
        x = graph("Add", observed, embedded)
    else:
        before = _time(graph, graph("Sub", time, graph.constant([1])))
        x = graph("Concat", graph("Add", embedded, before), observed, axis=0)
    old = graph("Expand", "past_mask", _joined(graph, [stride], graph("Shape", "past_mask")))
    visible = graph("Concat", old, graph.constant(np.tri(stride, dtype=bool), bool), axis=1)
    _transform(graph, x, visible, ("past_keys", "past_values"))
    graph.named(
        "Concat", "past_mask", graph.constant([True] * stride, bool), to="present_mask", axis=0
    )
    inputs = [
        _value("action", "INT64", []),
        _value("obs", "FLOAT", config.obs_shape),
        *_cache(config, "past", "S"),
    ]
    return graph.model("step", inputs, _outputs(config, "S_next"), facts)


def _transform(graph: Graph, x: str, visible: str, past: tuple[str, str] | None) -> None:
    """Add the Transformer and all outputs of the graph.

    Args:
      graph: the graph.
      x: new tokens ``[R, W]``.
      visible: which keys they attend to, ``[R, S + R]``.
      past: the inputs with the cached keys and values, if there is a cache.
    """
    config, keys, values = graph.config, [], []
    size = config.embed_dim // config.num_heads
    heads = graph.constant([-1, config.num_heads, size])

    def split(rows: str) -> str:
        return graph("Transpose", graph("Reshape", rows, heads), perm=[1, 0, 2])

    x = graph.norm(x, "norm_in")
    for layer in range(config.num_layers):
        name = f"blocks_{layer}"
        h = graph.norm(x, f"{name}/norm_attention")
        both = graph("Split", graph.dense(h, f"{name}/key_value"), num=2, axis=-1)
        key, value = map(split, both)
        if past is not None:
            old = [graph("Gather", part, graph.constant(layer), axis=0) for part in past]
            key, value = (
                graph("Concat", rows, new, axis=1)
                for rows, new in zip(old, (key, value), strict=True)
            )
        keys.append(key)
        values.append(value)
        query = split(graph.dense(h, f"{name}/query"))
        scores = graph("MatMul", query, graph("Transpose", key, perm=[0, 2, 1]))
        scores = graph("Mul", scores, graph.constant(size**-0.5, np.float32))
        scores = graph("Where", visible, scores, graph.constant(HIDDEN, np.float32))
        mixed = graph("MatMul", graph("Softmax", scores, axis=-1), value)
        rows = graph("Reshape", graph("Transpose", mixed, perm=[1, 0, 2]),
                     graph.constant([-1, config.embed_dim]))  # fmt: skip
        x = graph("Add", x, graph.dense(rows, f"{name}/mix"))
        h = graph.dense(graph.norm(x, f"{name}/norm_mlp"), f"{name}/expand")
        x = graph("Add", x, graph.dense(graph("Relu", h), f"{name}/contract"))
    last = graph("Gather", graph.norm(x, "norm_out"), graph.constant(-1), axis=0)
    head = graph("MatMul", last, graph.weight("head/kernel"))
    graph.named("Add", head, graph.weight("head/bias"), to="logits")
    graph.named("ArgMax", "logits", to="next_action", axis=0, keepdims=0)
    for name, parts in (("present_keys", keys), ("present_values", values)):
        layers = [graph("Unsqueeze", part, graph.constant([0])) for part in parts]
        graph.named("Concat", *layers, to=name, axis=0)


def _obs_token(graph: Graph) -> str:
    """The embedded observation ``[1, W]``; standardized first, if the policy was trained that way."""
    config = graph.config
    flat = graph("Reshape", "obs", graph.constant([1, -1]))
    if config.obs_mean:
        centered = graph("Sub", flat, graph.constant(config.obs_mean, np.float32))
        scaled = graph("Div", centered, graph.constant(config.obs_std, np.float32))
        limits = (graph.constant(limit, np.float32) for limit in (-OBS_LIMIT, OBS_LIMIT))
        flat = graph("Clip", scaled, *limits)
    return graph.dense(flat, "embed_obs")


def _time(graph: Graph, time: str) -> str:
    """The embedding ``[1, W]`` of a timestep ``[1]``."""
    return graph("Gather", graph.weight("embed_time"), time, axis=0)


def _one_hot(graph: Graph) -> str:
    """The previous action as a one-hot row ``[1, A]``."""
    row = graph("Unsqueeze", "action", graph.constant([0]))
    sizes = graph.constant(graph.config.action_dim), graph.constant([0, 1], np.float32)
    return graph("OneHot", row, *sizes, axis=-1)


def _joined(graph: Graph, first: list[int], rest: str) -> str:
    """A shape that consists of the sizes ``first`` and those of the shape ``rest``."""
    return graph("Concat", graph.constant(first), rest, axis=0)


def _value(name: str, dtype: str, shape: Any) -> Any:
    return helper.make_tensor_value_info(name, getattr(TensorProto, dtype), list(shape))


def _cache(config: TransformerConfig, when: str, tokens: int | str) -> list[Any]:
    size = config.embed_dim // config.num_heads
    shape = [config.num_layers, config.num_heads, tokens, size]
    return [
        _value(f"{when}_keys", "FLOAT", shape),
        _value(f"{when}_values", "FLOAT", shape),
        _value(f"{when}_mask", "BOOL", [tokens]),
    ]


def _outputs(config: TransformerConfig, tokens: int | str) -> list[Any]:
    logits = _value("logits", "FLOAT", [config.action_dim])
    return [logits, _value("next_action", "INT64", []), *_cache(config, "present", tokens)]
