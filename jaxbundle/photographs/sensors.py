"""Widths of sensors, mm, of cameras that state a focal length but not its film equivalent.

From the makers' data sheets; the longer side. Other cameras need the equivalent focal
length in their files, a calibration, or photographs that determine the principal distance.
"""

WIDTHS = {
    "canon eos 5d": 36.0,
    "canon eos 6d": 36.0,
    "canon eos r": 36.0,
    "canon eos r7": 22.3,
    "canon eos r10": 22.3,
    "canon eos r50": 22.3,
    "canon eos r100": 22.3,
    "canon eos rebel": 22.3,
    "canon eos d60": 22.7,
    "canon eos 10d": 22.7,
    "canon eos 20d": 22.5,
    "canon eos 30d": 22.5,
    "canon eos 40d": 22.2,
    "canon eos 50d": 22.3,
    "canon eos 60d": 22.3,
    "canon eos 70d": 22.5,
    "canon eos 80d": 22.5,
    "canon eos 7d": 22.3,
    "canon eos 300d": 22.7,
    "canon eos 350d": 22.2,
    "canon eos 400d": 22.2,
    "canon eos 450d": 22.2,
    "canon eos 500d": 22.3,
    "canon eos 550d": 22.3,
    "canon eos 600d": 22.3,
    "canon ixus 220hs": 6.17,
    "canon powershot s100": 7.44,
    "canon powershot s110": 7.44,
    "canon powershot g10": 7.44,
    "canon powershot sx260": 6.17,
    "canon powershot elph 110": 6.17,
    "nikon d100": 23.7,
    "nikon d200": 23.6,
    "nikon d300": 23.6,
    "nikon d3": 36.0,
    "nikon d40": 23.7,
    "nikon d50": 23.7,
    "nikon d60": 23.6,
    "nikon d70": 23.7,
    "nikon d80": 23.6,
    "nikon d90": 23.6,
    "nikon d3000": 23.6,
    "nikon d3100": 23.1,
    "nikon d3200": 23.2,
    "nikon d5000": 23.6,
    "nikon d5100": 23.6,
    "nikon d600": 35.9,
    "nikon d700": 36.0,
    "nikon d7000": 23.6,
    "nikon d750": 35.9,
    "nikon d800": 35.9,
    "nikon d810": 35.9,
    "nikon d850": 35.9,
    "nikon coolpix 995": 7.18,
    "sony nex-5": 23.4,
    "sony nex-6": 23.5,
    "sony nex-7": 23.5,
    "sony ilce-5100": 23.5,
    "sony ilce-6000": 23.5,
    "sony ilce-7r": 35.9,
    "sony ilce-7": 35.8,
    "sony dsc-rx100": 13.2,
    "sony dsc-rx1": 35.8,
    "sony dsc-wx220": 6.16,
    "panasonic dmc-gf1": 17.3,
    "panasonic dmc-gx1": 17.3,
    "olympus e-p1": 17.3,
    "fujifilm finepix s5600": 5.76,
    "leica m9": 36.0,
    "hasselblad l1d-20c": 13.2,
    "dji fc200": 6.17,
    "dji fc300": 6.17,
    "dji fc330": 6.17,
    "dji fc350": 6.17,
    "dji fc550": 17.3,
    "dji fc220": 6.17,
    "dji fc2103": 6.17,
    "dji fc2204": 6.17,
    "dji fc3170": 6.4,
    "dji fc3411": 13.2,
    "dji fc6310": 13.2, "dji fc6360": 4.87, "dji fc6510": 13.2, "dji fc6520": 17.3,
    "dji fc7203": 6.3, "dji zenmusep1": 35.9, "dji m3e": 17.3, "dji l1d-20c": 13.2,
    "parrot bebop": 6.17, "parrot anafi": 5.9, "sensefly s.o.d.a.": 12.75,
    "gopro hero3": 6.17, "gopro hero4": 6.17, "ricoh gr": 23.6, "pentax k-5": 23.7,
    "ricoh gr digital": 7.18, "ricoh gr digital 2": 7.31, "ricoh gr digital 3": 7.44,
    "ricoh gr digital 4": 7.44,
}  # fmt: skip


def sensor_width(make: str, model: str) -> float | None:
    """The longer side of a camera's sensor in mm; None if it is not known."""
    make, model = make.lower().strip(), " ".join(model.lower().split())
    brand = make.split(" ")[0]
    name = model if brand and model.startswith(brand) else f"{brand} {model}"
    # A known name that continues with a digit is another camera: a D80 is not a D800.
    continues = lambda known_name: (
        known_name[-1].isdigit() and name[len(known_name) :][:1].isdigit()
    )
    candidates = (
        known_name
        for known_name in WIDTHS
        if name.startswith(known_name) and not continues(known_name)
    )
    best = max(candidates, key=len, default=None)
    return None if best is None else WIDTHS[best]
