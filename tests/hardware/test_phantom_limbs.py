"""Motors that do nothing."""

import copy
import pickle

import numpy as np
import pytest

from hardware import PanoramaHead, PhantomLimbs

SCENE = np.random.default_rng(0).integers(0, 255, (100, 200), dtype=np.uint8)


def heads(phantoms=3):
    bare = PanoramaHead(SCENE, size=(24, 32))
    return bare, PhantomLimbs(PanoramaHead(SCENE, size=(24, 32)), phantoms)


@pytest.mark.parametrize("phantoms", [0, 1, 3])
def test_a_head_with_phantoms_is_the_head(phantoms):
    bare, dressed = heads(phantoms)
    assert dressed.motors == 2 + phantoms and dressed.size == (24, 32)
    random = np.random.default_rng(1)
    for body in (bare, dressed):
        body.reset(5)
    for _ in range(4):
        command = random.uniform(-0.3, 0.3, 2 + phantoms)
        assert np.array_equal(bare.step(command[:2]), dressed.step(command))
        assert np.array_equal(bare.angles, dressed.angles)
    dressed.turn(np.concatenate([[0.0, 0.0], np.ones(phantoms)]))
    assert np.array_equal(bare.angles, dressed.angles)


def test_angles_are_the_heads_own():
    _, dressed = heads()
    dressed.angles = np.array([4.0, -2.0])
    assert dressed.head.angles.tolist() == [4.0, -2.0]
    with dressed.noiseless():
        dressed.turn([0.1, 0.0, 9.0, 9.0, 9.0])
    assert dressed.angles.tolist() == pytest.approx([10.0, -2.0])


def test_it_can_be_copied_and_pickled():
    _, dressed = heads()
    for twin in (copy.deepcopy(dressed), pickle.loads(pickle.dumps(dressed))):
        assert twin.motors == 5 and np.array_equal(twin.step(np.zeros(5)), copy.deepcopy(dressed).step(np.zeros(5)))


@pytest.mark.parametrize("command", [[0.1, 0.2], [0.0] * 4, [0.0] * 6])
def test_bad_commands(command):
    with pytest.raises(ValueError, match="5 numbers"):
        heads()[1].turn(command)
    with pytest.raises(ValueError, match="5 numbers"):
        heads()[1].step(command)


def test_bad_phantoms_and_what_a_head_does_not_have():
    with pytest.raises(ValueError, match="0 phantoms or more"):
        heads(-1)
    with pytest.raises(AttributeError, match="wings"):
        _ = heads()[1].wings
