"""The soak test: trainings with faults, compared with an undisturbed one."""
