"""The loss against its closed form and its limits."""

import torch
from torch.testing import assert_close

from unmix_plugin.neumatex.prior.beta_nll import beta_nll


def numbers(seed: int) -> torch.Tensor:
    return torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_with_beta_0_it_is_the_likelihood_of_a_gaussian():
    predicted, log_variance, target = numbers(0), numbers(1), numbers(2)
    gaussian = torch.distributions.Normal(predicted, (0.5 * log_variance).exp())
    constant = 0.5 * torch.log(torch.tensor(2 * torch.pi, dtype=torch.float64))
    assert_close(
        beta_nll(predicted, log_variance, target, beta=0.0), -(gaussian.log_prob(target) + constant).mean()
    )


def test_with_beta_a_half_each_likelihood_counts_its_standard_deviation_and_that_has_no_gradient():
    predicted, log_variance, target = numbers(0).requires_grad_(), numbers(1).requires_grad_(), numbers(2)
    deviation = (0.5 * log_variance).exp().detach()
    expected = (deviation * 0.5 * ((predicted - target) ** 2 / log_variance.exp() + log_variance)).mean()
    actual = beta_nll(predicted, log_variance, target)
    assert_close(actual, expected)
    found = torch.autograd.grad(actual, [predicted, log_variance])
    assert_close(found, torch.autograd.grad(expected, [predicted, log_variance]))


def test_with_beta_1_the_mean_is_pulled_as_by_the_squared_error():
    predicted, log_variance, target = numbers(0).requires_grad_(), numbers(1), numbers(2)
    found = torch.autograd.grad(beta_nll(predicted, log_variance, target, beta=1.0), predicted)
    assert_close(found, torch.autograd.grad(0.5 * (predicted - target).square().mean(), predicted))


def test_the_best_variance_is_the_squared_error():
    predicted, target = numbers(0), numbers(2)
    log_variance = (predicted - target).square().log().requires_grad_()
    gradient = torch.autograd.grad(beta_nll(predicted, log_variance, target), log_variance)[0]
    assert_close(gradient, torch.zeros_like(gradient))
