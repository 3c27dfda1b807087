"""The result of an adjustment as one page of HTML, for a browser and for paper.

    pieces = jaxbundle.report.page.compose(adjustment)
    Path("report.html").write_text("".join(pieces))
"""

from jaxbundle.report.page.document import compose as compose
from jaxbundle.report.page.document import compose_failure as compose_failure
from jaxbundle.report.page.origin import UNKNOWN as UNKNOWN
from jaxbundle.report.page.origin import InputFile as InputFile
from jaxbundle.report.page.origin import Origin as Origin
from jaxbundle.report.page.origin import fingerprint_files as fingerprint_files
