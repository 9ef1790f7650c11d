"""Genie (reference: 1xgpt's STMaskGIT): RoboScape's RGB branch, trained with cross-entropy only."""
