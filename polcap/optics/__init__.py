"""Physics and image mathematics that several packages use; where stated, for NumPy and torch arrays."""

from polcap.errors import SettingError

_REMEDY = "pip uninstall -y opencv-python opencv-python-headless opencv-contrib-python opencv-contrib-python-headless; "
_REMEDY += "pip install 'opencv-contrib-python-headless>=5'"
try:
    import cv2

    _found = f"the module cv2 is OpenCV {cv2.__version__}"
    _fits = int(cv2.__version__.partition(".")[0]) >= 5 and hasattr(cv2, "mcc")
except (ImportError, AttributeError) as error:
    _found, _fits = f"the module cv2 cannot be imported ({error})", False
if not _fits:
    raise SettingError(f"{_found}; polcap needs OpenCV 5 with its contrib modules: {_REMEDY}")
