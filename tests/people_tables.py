"""Tables of participants, made up."""

import numpy as np
import pandas as pd


def participants(n=60, seed=0):
    random = np.random.default_rng(seed)
    return pd.DataFrame(
        {
            "group": np.array(["CU", "MCI", "DAT"])[np.arange(n) % 3],
            "age": random.normal(70, 8, n).round(1),
            "sex": np.array(["F", "M"])[random.integers(0, 2, n)],
            "site": "one",
        },
        index=[f"sub-{i:02d}" for i in range(n)],
    )
