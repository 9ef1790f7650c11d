"""Simulated robot episodes with exact labels: robosuite's Lift, a scripted expert, tracks and depth."""
