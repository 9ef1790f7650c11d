"""Tests the paper's claims at small scale: ``python -m experiments.paper`` trains, measures and judges each."""
