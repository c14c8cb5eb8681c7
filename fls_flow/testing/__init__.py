"""For tests and notebooks: run a graph on lists, and hold a node to the contract that every plugin keeps."""

from fls_flow.testing.contract import check_node
from fls_flow.testing.graphs import run_graph
from fls_flow.testing.samples import sample_firings

__all__ = ["check_node", "run_graph", "sample_firings"]
