"""The subcommand `diagnose`: where the model is wrong, which effect is missing, how far the gap shrinks."""

import argparse
from pathlib import Path

from estimator.commands.arguments import add_output, add_settings, whole_number
from estimator.commands.complaints import complain
from estimator.commands.diagnosis_tables import print_diagnosis
from estimator.commands.log_options import (
    RECORDED,
    add_channels,
    add_effects,
    add_map,
    add_seed,
    check_outputs,
    complain_of_channels,
    complain_of_databases,
    settings,
)
from estimator.commands.terminal import print_json, progress_bar, standard_output
from estimator.report import diagnosis_page, traces_file
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.report.page import document
from estimator.streaming.drive_extraction import diagnose_logs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument("log", nargs="+", type=Path, metavar="LOG", help=f"drives of one vehicle; {RECORDED}")
    parser.add_argument("--report", type=Path, metavar="OUT.html", help="one page with figures, opens offline")
    power = "measured and modelled power, the rows that the page draws"
    parser.add_argument("--traces", type=Path, metavar="OUT.csv", help=power)
    exact = "look for effects in N records of noise like this one's as well, for a p-value"
    parser.add_argument("--exact", type=whole_number, default=0, metavar="N", help=exact)
    add_effects(parser)
    add_channels(parser)
    add_map(parser)
    add_seed(parser, "bootstrap")


def run(options: argparse.Namespace) -> int:
    """Diagnose, write the page asked for, and print the answer."""
    check_outputs(options.log, {options.report: document.FORMATS, options.traces: traces_file.FORMATS})
    with progress_bar("diagnose") as progress:
        diagnosis = diagnose_logs(options.log, settings(options), progress, surrogates=options.exact)
    if options.report is not None:
        diagnosis_page.write_page(diagnosis, options.report)
    if options.traces is not None and diagnosis.traces is not None:
        traces_file.write_traces(diagnosis.traces, options.traces)
    elif options.traces is not None:
        complain("note: there is no fit, so no traces were written")
    complain_of_channels(diagnosis.mixed_channels)
    complain_of_databases(settings(options))
    for doubt in diagnosis.doubts:
        complain(f"note: {doubt}")
    if options.json:
        print_json(of_diagnosis(diagnosis))
    else:
        print_diagnosis(standard_output(), diagnosis)
    return 0
