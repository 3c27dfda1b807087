"""Small control networks of ISIS as text, and the head of jigsaw's residuals."""

import numpy as np

HEAD = """Object = ControlNetwork
  NetworkId    = test
  TargetName   = Earth
  Description  = "Of a test,
                  in two lines"
  Version      = 5
"""


def measure(serial, line, sample, more=""):
    return f"""
    Group = ControlMeasure
      SerialNumber   = {serial}
      MeasureType    = RegisteredSubPixel
      ChooserName    = jigsaw
      Sample         = {sample + 1!r}
      Line           = {line + 1!r}
      SampleResidual = 0.3 <pixels>
      LineResidual   = -0.4 <pixels>{more}
    End_Group
"""


def point(id, kind, X, covariance, measures):
    lines = [f"\n  Object = ControlPoint\n    PointType = {kind}\n    PointId   = {id}"]
    for axis, value in zip("XYZ", X):
        lines.append(f"\n    # a comment of Apriori{axis}\n    Apriori{axis} = {value!r} <meters>")
    if covariance is not None:
        six = [repr(float(v)) for v in covariance[np.triu_indices(3)]]
        # two lines, as of ISIS
        matrix = f"({', '.join(six[:4])},\n       {', '.join(six[4:])})"
        lines.append(f"    AprioriCovarianceMatrix = {matrix}")
    return "\n".join(lines) + "\n" + "".join(measures) + "  End_Object\n"


RESIDUALS = """,,,x image,y image,Measured,Measured,sample,line,Residual Vector
Point,Image,Image,coordinate,coordinate,Sample,Line,residual,residual,Magnitude
Label,Filename,Serial Number,(mm),(mm),(pixels),(pixels),(pixels),(pixels),(pixels),Rejected
"""
GOOD = HEAD + point("P", "Constrained", [1e6, 2e6, 3e6], np.eye(3), [measure("s", 4.0, 7.0)])
