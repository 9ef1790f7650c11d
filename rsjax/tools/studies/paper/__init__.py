"""Tests the paper's claims at small scale: ``rsjax paper`` trains, measures and judges each."""
