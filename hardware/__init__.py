"""Bodies: what turns an action into the next observation, and the devices under them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hardware.body import Body as Body
    from hardware.camera import Camera as Camera
    from hardware.camera import CameraError as CameraError
    from hardware.camera_opencv import OpenCVCamera as OpenCVCamera
    from hardware.camera_video import VideoCamera as VideoCamera
    from hardware.detectors import CascadeDetector as CascadeDetector
    from hardware.detectors import Detector as Detector
    from hardware.detectors import LBPDetector as LBPDetector
    from hardware.dynamixel import Dynamixel as Dynamixel
    from hardware.feetech import Feetech as Feetech
    from hardware.fovea import Fovea as Fovea
    from hardware.heads import DiegoSan as DiegoSan
    from hardware.heads import Einstein as Einstein
    from hardware.heads import Nobody as Nobody
    from hardware.maestro import Maestro as Maestro
    from hardware.motors import MotorError as MotorError
    from hardware.motors import Motors as Motors
    from hardware.pan_tilt_camera import PanTiltCamera as PanTiltCamera
    from hardware.panorama_head import PanoramaHead as PanoramaHead
    from hardware.people import Person as Person
    from hardware.phantom_limbs import PhantomLimbs as PhantomLimbs
    from hardware.photo import PhotoError as PhotoError
    from hardware.photo import read_photo as read_photo
    from hardware.photo_eye import PhotoEye as PhotoEye
    from hardware.photo_eye import whole_image as whole_image
    from hardware.physics_head import Joint as Joint
    from hardware.physics_head import PhysicsHead as PhysicsHead
    from hardware.room import Room as Room
    from hardware.simulated import Simulated as Simulated
    from hardware.sound import Microphone as Microphone
    from hardware.sound import SoundError as SoundError
    from hardware.sound import Speaker as Speaker
    from hardware.sound_booth import SoundBooth as SoundBooth
    from hardware.sound_card import SoundCard as SoundCard
    from hardware.sound_file import SoundFile as SoundFile
    from hardware.sound_file import read_sound as read_sound
    from hardware.two_means import TwoMeans as TwoMeans
    from hardware.virtual_room import Caregiver as Caregiver
    from hardware.virtual_room import VirtualRoom as VirtualRoom

# Public names and their files.  They are imported when first used, so that `import hardware` is quick.
_FILES = {
    "Body": "body",
    "Simulated": "simulated",
    # Heads.
    "DiegoSan": "heads",
    "Einstein": "heads",
    "Joint": "physics_head",
    "Nobody": "heads",
    "PanoramaHead": "panorama_head",
    "Person": "people",
    "PhantomLimbs": "phantom_limbs",
    "PhysicsHead": "physics_head",
    "Room": "room",
    "PanTiltCamera": "pan_tilt_camera",
    "Camera": "camera",
    "CameraError": "camera",
    "OpenCVCamera": "camera_opencv",
    "VideoCamera": "camera_video",
    "Motors": "motors",
    "MotorError": "motors",
    "Dynamixel": "dynamixel",
    "Feetech": "feetech",
    "Maestro": "maestro",
    # The digital eye.
    "CascadeDetector": "detectors",
    "Detector": "detectors",
    "LBPDetector": "detectors",
    "Fovea": "fovea",
    "PhotoError": "photo",
    "read_photo": "photo",
    "PhotoEye": "photo_eye",
    "whole_image": "photo_eye",
    # Sound.
    "Microphone": "sound",
    "SoundError": "sound",
    "Speaker": "sound",
    "SoundBooth": "sound_booth",
    "SoundCard": "sound_card",
    "SoundFile": "sound_file",
    "read_sound": "sound_file",
    "TwoMeans": "two_means",
    "Caregiver": "virtual_room",
    "VirtualRoom": "virtual_room",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for."""
    if name in _FILES:
        return getattr(import_module(f"hardware.{_FILES[name]}"), name)
    raise AttributeError(f"module 'hardware' has no attribute '{name}'")


def __dir__() -> list[str]:
    """All public names."""
    return [*globals(), *_FILES]
