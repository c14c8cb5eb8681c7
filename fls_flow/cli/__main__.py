"""`python -m fls_flow.cli`."""

from fls_flow.cli import main

main()
