"""The paper's claims, each trained for, measured and judged in small by ``python -m experiments.paper``."""
