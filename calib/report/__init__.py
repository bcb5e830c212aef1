"""Reports as HTML and PDF, composed of `Heading`, `Text`, `Table`, `Picture` and `Listing`; and figures as files."""

from calib.report.campaign import (
    check_places,
    write_comparison_figures,
    write_survey_report,
    write_track_figures,
)
from calib.report.plans import write_plan
from calib.report.results import origin_of
from uwblink.pages.blocks import Heading, Listing, Picture, Table, Text

__all__ = [
    "Heading",
    "Listing",
    "Picture",
    "Table",
    "Text",
    "check_places",
    "origin_of",
    "write_comparison_figures",
    "write_plan",
    "write_survey_report",
    "write_track_figures",
]
