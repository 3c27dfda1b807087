"""`jaxbundle pushbroom info`: what a file says of its image."""

from jaxbundle.cli.pushbroom.app import ImageFile, Json, Level, pushbroom


@pushbroom.command(example="out/flight/scanner.toml")
def info(scanner: ImageFile, height: Level = None, json: Json = "") -> None:
    """Size, ground sampling, view, footprint, corrections; agreement with the RPC of a product."""
    from jaxbundle import pushbroom as line_scanners
    from jaxbundle.cli.outputs import print_result
    from jaxbundle.cli.pushbroom.shared import check_outputs, warn

    check_outputs([scanner], json=json)
    print_result(line_scanners.info(scanner, height=height, tell=warn), json)
