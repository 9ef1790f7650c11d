"""Many runs and one answer: ablations, comparisons, the paper's claims, reports."""
