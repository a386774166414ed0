"""The small networks of a contract, in closed form."""

import numpy as np

from kibs_steps.models import perceptron


def test_a_network_of_two_layers_in_closed_form():
    n = 7
    seen = np.zeros((2, n))
    seen[:, 0] = (3.0, 100.0)  # (3 − 1) / 2 = 1; beyond 5 clipped
    first = np.zeros((n, 2))
    first[0] = (1.0, -1.0)
    terms = {"mean": [1.0] * n, "spread": [2.0] * n}
    terms["layers"] = [
        {"weights": first.tolist(), "bias": [0.5, 0.0]},
        {"weights": [[2.0], [9.0]], "bias": [-1.0]},
    ]
    np.testing.assert_allclose(perceptron.likely(seen, terms), 1 / (1 + np.exp([-2.0, -10.0])))
    assert perceptron.leads(terms, n)
    assert not perceptron.leads(terms, n + 1)
    assert not perceptron.leads({**terms, "mean": [1.0]}, n)
    assert not perceptron.leads({**terms, "layers": terms["layers"][:1]}, n)
