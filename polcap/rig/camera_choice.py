"""A camera's name in, the camera out."""

from polcap.errors import SettingError
from polcap.rig import camera_folder, camera_gphoto2
from polcap.rig.camera import Camera
from polcap.rig.log import Log


def open_camera(name: str, log: Log) -> Camera:
    """`gphoto2`, `gphoto2:MODEL or PORT`, `folder:PATH` or `simulated?width=768`.

    Raises
    ------
    SettingError
        There is no such camera, or a query names an unknown setting.
    HardwareError
        It does not answer.
    """
    kind, _, rest = name.partition(":")
    if kind == "gphoto2":
        return camera_gphoto2.Gphoto2(rest, log)
    if kind == "folder" and rest:
        return camera_folder.WatchedFolder(rest, log)
    if name.partition("?")[0] == "simulated":
        from polcap.rig import simulated  # here: it is heavy

        return simulated.Camera(name.partition("?")[2], log)
    raise SettingError(f"--camera {name}: no such camera; give gphoto2, gphoto2:MODEL, folder:PATH or simulated")
