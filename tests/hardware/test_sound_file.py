"""Recordings of every width, rate and number of channels, whole and broken."""

import numpy as np
import pytest
import soundfile

from hardware import SoundError, SoundFile, read_sound
from hardware.sound import decibels
from hardware.sound_file import clipped


def tone(rate, seconds=1.0, level=0.5):
    return level * np.sin(2 * np.pi * 440 * np.arange(round(rate * seconds)) / rate)


@pytest.mark.parametrize("subtype", ["PCM_U8", "PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE", "ULAW"])
@pytest.mark.parametrize("rate", [8000, 11025, 44100, 96000])
def test_every_width_and_rate(tmp_path, subtype, rate):
    soundfile.write(tmp_path / "a.wav", tone(rate), rate, subtype=subtype)
    sound, found = read_sound(tmp_path / "a.wav")
    assert found == rate and sound.dtype == np.float32
    np.testing.assert_allclose(sound, tone(rate), atol=0.02)


def test_other_formats(tmp_path):
    soundfile.write(tmp_path / "a.flac", tone(16000), 16000)
    np.testing.assert_allclose(read_sound(tmp_path / "a.flac")[0], tone(16000), atol=1e-4)


def test_stereo_is_mixed_and_does_not_cancel(tmp_path):
    left = tone(8000)
    for right, level in ((left, 0.5), (-left, 0.5), (0 * left, 0.25)):
        soundfile.write(tmp_path / "a.wav", np.stack([left, right], 1), 8000, subtype="FLOAT")
        assert np.abs(read_sound(tmp_path / "a.wav")[0]).max() == pytest.approx(level, abs=0.01)


def test_a_file_that_is_cut_short_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "a.wav"
    soundfile.write(path, tone(8000), 8000, subtype="PCM_16")
    path.write_bytes(path.read_bytes()[:-5001])  # in the middle of a sample
    sound, _ = read_sound(path)
    assert len(sound) == 8000 - 2501
    np.testing.assert_allclose(sound, tone(8000)[: len(sound)], atol=1e-3)


def test_clipping_is_measured(tmp_path):
    assert clipped(np.clip(tone(8000, level=2.0), -1, 1)) == pytest.approx(2 / 3, abs=0.01)
    assert clipped(tone(8000)) == 0
    # The largest sample of 16 bits is below 1.
    soundfile.write(tmp_path / "a.wav", np.full(100, 1.0), 8000)
    assert clipped(read_sound(tmp_path / "a.wav")[0]) == 1


def test_a_recording_is_a_microphone(tmp_path):
    soundfile.write(tmp_path / "a.wav", tone(8000), 8000, subtype="FLOAT")
    microphone = SoundFile(tmp_path / "a.wav")
    first = microphone.read(3000)
    second = microphone.read(5000)
    np.testing.assert_allclose(np.concatenate([first, second]), tone(8000), atol=1e-6)
    with pytest.raises(SoundError, match=r"is over after 1.0 s\."):
        microphone.read(1)
    microphone.reset()
    assert decibels(microphone.read(8000)) == pytest.approx(10 * np.log10(0.125), abs=0.01)


def broken(folder):
    (folder / "folder").mkdir()
    (folder / "text.wav").write_text("not a sound")
    (folder / "empty.wav").write_bytes(b"")
    soundfile.write(folder / "none.wav", np.zeros(0), 8000)
    soundfile.write(folder / "silent.wav", np.zeros(8000), 8000)
    soundfile.write(folder / "slow.wav", tone(1000), 1000)
    nan = tone(8000)
    nan[5] = np.nan
    soundfile.write(folder / "nan.wav", nan, 8000, subtype="FLOAT")


@pytest.mark.parametrize(
    "name, said",
    [
        ("missing.wav", "is not there"),
        ("folder", "is a folder"),
        ("text.wav", "cannot be read"),
        ("empty.wav", "cannot be read"),
        ("none.wav", "no sound at all"),
        ("silent.wav", "was the microphone on"),
        ("slow.wav", "1000 samples a second"),
        ("nan.wav", "no numbers"),
    ],
)
def test_broken_recordings(tmp_path, name, said):
    broken(tmp_path)
    with pytest.raises(SoundError) as error:
        read_sound(tmp_path / name)
    assert said in str(error.value) and name in str(error.value) and "\n" not in str(error.value)
