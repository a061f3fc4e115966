"""A function of tensors as a flat list of operations."""

import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

from kernels.modes import in_full_precision

COPIES = {  # and other names of the same values
    getattr(torch.ops.aten, name).default for name in ("alias", "detach", "clone", "lift_fresh_copy")
}

TRACING = threading.RLock()  # PyTorch's tracer changes what all threads share


@in_full_precision
@torch.no_grad()
def traced(function: Callable[..., list[Tensor]], *examples: Tensor) -> GraphModule:
    """`function` as a flat list of operations on tensors like the examples.

    Nested forward-mode differentiation is most of the time of a call for few columns; make_fx does it once.
    """
    # a second that a command without it need not wait
    from torch._guards import TracingContext, tracing
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    def plain(*tensors: Tensor) -> list[Tensor]:
        return function(*tensors)

    pure = torch.func.functionalize(plain, remove="mutations")  # mutations would hide common subexpressions
    # PyTorch notes each value's shape; without one mode for all it makes a mode for each, which takes half of the time
    shapes = TracingContext(FakeTensorMode())
    with TRACING, tracing(shapes):
        return without_repetitions(make_fx(pure)(*examples))


def without_repetitions(graph: GraphModule) -> GraphModule:
    """The graph with equal constants and common subexpressions computed once: several constraints begin alike.

    Copies are left out, which hide what is equal, but for those in another order in memory, which a view may need.
    Nothing writes in place, as the graph is functional.
    """
    from torch._functorch.compile_utils import fx_graph_cse

    for node in [node for node in graph.graph.nodes if node.target in COPIES]:
        if node.meta["val"].stride() == node.args[0].meta["val"].stride():
            node.replace_all_uses_with(node.args[0])
    seen: dict[tuple[Any, ...], Node] = {}
    for node in graph.graph.find_nodes(op="get_attr"):
        constant = getattr(graph, node.target)
        same = seen.setdefault((constant.dtype, constant.shape, constant.cpu().numpy().tobytes()), node)
        if same is not node:
            node.replace_all_uses_with(same)
    short = fx_graph_cse(graph.graph)
    short.eliminate_dead_code()
    return GraphModule(graph, short)
