"""The calibration of a camera that Metashape saves: Tools > Camera Calibration > Save.

    <calibration>
      <projection>frame</projection>     frame, fisheye, equisolid_fisheye, spherical, …
      <width>6000</width> <height>4000</height>
      <f> <cx> <cy> <k1> … <p1> <p2> <b1> <b2> <date>
    </calibration>

The numbers are those of a sensor in the XML of cameras (`networks.metashape_camera`). Old versions
have fx, fy, cx, cy from the corner, skew.

Source: Agisoft Metashape user manual, "Camera calibration", and its appendix "Camera models".
"""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from jaxbundle.io.cameras.nearest_camera import with_messages
from jaxbundle.io.networks.metashape_camera import CALIBRATION_KEYS, sensor_camera
from jaxbundle.io.text.known_keys import Keys, UnknownKeys
from jaxbundle.io.text.xml_fields import XmlFields, read_xml
from jaxbundle.network.build import make_cameras
from jaxbundle.network.tables import Camera
from jaxbundle.system.file_content import beginning

KEYS = Keys(("projection", "width", "height")) | CALIBRATION_KEYS


def is_metashape_lens(path: Path) -> bool:
    """Whether an XML file has a calibration as its root, with a projection."""
    head = beginning(path, 4000) if path.suffix.lower() == ".xml" else b""
    root = re.search(rb"<(?![?!])\s*(\w+)", head)
    return root is not None and root[1] == b"calibration" and b"<projection" in head


def read_metashape_lens(path: str | Path) -> Camera:
    """The camera of a file; its id is the name of the file.

    **Raises:** `InputError` naming file and element.
    """
    path = Path(path)
    root = read_xml(path)
    xml, unknown = XmlFields(path, root, "a camera calibration of Metashape"), UnknownKeys()
    unknown.check_element(root, KEYS, path)
    sensor = ET.Element("sensor", {"type": xml.text("projection"), "label": path.stem})
    size = {key: str(xml.number(key)) for key in ("width", "height")}
    sensor.append(ET.Element("resolution", size))
    calibration = ET.Element("calibration", {"class": "adjusted"})
    calibration.extend(element for element in root if element.tag not in KEYS.used[:3])
    sensor.append(calibration)
    entry, messages = sensor_camera(path, sensor)
    (camera,) = make_cameras([entry], f"{path}, ")
    return with_messages(camera, *messages, *unknown.messages())
