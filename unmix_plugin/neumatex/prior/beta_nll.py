"""The loss that teaches a network how wrong it is.

Source:
    Seitzer et al. 2022, On the Pitfalls of Heteroscedastic Uncertainty Estimation with Probabilistic Neural Networks.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def beta_nll(
    predicted: Float[Tensor, "*n P"],
    log_variance: Float[Tensor, "*n P"],
    target: Float[Tensor, "*n P"],
    beta: float = 0.5,
) -> Float[Tensor, ""]:
    """Mean negative log-likelihood of Gaussians, without its constant, each weighted by its variance to the power beta.

    The weight carries no gradient. With beta 0 it is the plain likelihood, with beta 1 the mean's gradient is that of
    half the squared error.
    """
    likelihood = 0.5 * ((predicted - target).square() * torch.exp(-log_variance) + log_variance)
    return (likelihood * torch.exp(beta * log_variance.detach())).mean()
