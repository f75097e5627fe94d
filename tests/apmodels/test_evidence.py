import pytest
import torch

from apmodels import Evidence


def test_an_evidence_scores_what_it_is_given():
    law = Evidence(lambda image: image[2] - 1.0)
    assert law.log_prob(torch.tensor([0.0, 0.0, 3.0])) == 2.0
    assert law.batch_shape == law.event_shape == ()


def test_an_evidence_is_not_drawn():
    law = Evidence(lambda image: image.sum())
    for draw in (law.sample, law.rsample, lambda: law((3,))):
        with pytest.raises(NotImplementedError, match="scored but not drawn"):
            draw()


@pytest.mark.parametrize("wrong", [torch.tensor(1.0), 0.5, None])
def test_an_evidence_takes_a_function(wrong):
    with pytest.raises(TypeError, match=r"takes a function .*write Evidence\(lambda"):
        Evidence(wrong)
