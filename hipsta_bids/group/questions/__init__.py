"""From a cohort to results: one module for each question of the group level."""
