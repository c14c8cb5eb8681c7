"""The contestants of `benchmarks/transport.py`: each a module with `send` and `receive`."""
