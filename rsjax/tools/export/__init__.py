"""Writes stores of clips in formats that other projects train on."""
