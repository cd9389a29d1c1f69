"""Rewriting of imperfect DBC files so that cantools reads them; unusable statements are left out and counted.

cantools refuses a whole file for one line that it cannot parse, or for one statement about a signal that does not
exist. Here each statement is read by itself and written again in one regular form. The grammar is that of the format
("DBC File Format Documentation", Vector, 2007), with the exceptions that other tools accept. Statements without a use
for decoding (nodes, environment variables, signal groups, other attributes) are left out and not counted.
"""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

EXTENDED = 1 << 31  # of an identifier in a DBC: the frame has 29 bits
STANDARD_BITS, EXTENDED_BITS = 11, 29
UNASSIGNED = "VECTOR__INDEPENDENT_SIG_MSG"  # holds the signals of no message
MAX_BYTES = 1 << 16  # of a message: the longest transport protocol carries 4 GB, no message that is used over 4 KB
MAX_LAYOUT_BITS = 8 * MAX_BYTES  # cantools lays out every bit of a message, so a larger number fills the memory
MAX_SELECTING = 1 << 12  # values of a multiplexer that select a signal; cantools makes a list of them
ORIGINAL_NAME = "OriginalName"  # attribute of a signal or message whose name is another one here than in the file
LONG_NAMES = ("SystemSignalLongSymbol", "SystemMessageLongSymbol")
CYCLE, FORMAT, SPN = "GenMsgCycleTime", "VFrameFormat", "SPN"
MAX_SPN_DIGITS = 6  # of 19 bits (J1939-71)
FORMATS = ["StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *["reserved"] * 10, "StandardCAN_FD", "ExtendedCAN_FD"]
_WORDS_OF_THE_FORMAT = (
    "BA_ BA_DEF_ BA_DEF_DEF_ BA_DEF_DEF_REL_ BA_DEF_REL_ BA_DEF_SGTYPE_ BA_REL_ BA_SGTYPE_ BO_ BO_TX_BU_ BS_ BU_ "
    "BU_BO_REL_ BU_EV_REL_ BU_SG_REL_ CAT_ CAT_DEF_ CM_ ENVVAR_DATA_ EV_ EV_DATA_ FILTER NS_ NS_DESC_ SG_ SG_MUL_VAL_ "
    "SGTYPE_ SGTYPE_VAL_ SIG_GROUP_ SIG_TYPE_REF_ SIG_VALTYPE_ SIGTYPE_VALTYPE_ VAL_ VAL_TABLE_ VERSION"
)
KEYWORDS = frozenset(_WORDS_OF_THE_FORMAT.split())

_NAME = r'([^\s:;,"|@()\[\]]+)'
_IDENT = r"(\d{1,10})"
_NUMBER = r"([-+]?(?:\d{1,40}\.?\d{0,40}|\.\d{1,40})(?:[eE][-+]?\d{1,3})?)"
_TEXT = r'"((?:\\"|[^"])*)"'
_END = r"[ \t]*(?:;|(?=\n)|\Z)"  # files without some semicolons are read
_MESSAGE = re.compile(rf"BO_\s+{_IDENT}\s+{_NAME}\s*:\s*(\d{{1,10}})[^\n]*")
_SIGNAL = re.compile(
    rf"SG_\s+{_NAME}(?:\s+(M|m|m\d{{1,10}}M?))?\s*:\s*(\d{{1,10}})\s*\|\s*(\d{{1,10}})\s*@\s*([01])\s*([-+])\s*"
    rf"\(\s*{_NUMBER}\s*,\s*{_NUMBER}\s*\)(?:\s*\[\s*{_NUMBER}\s*\|\s*{_NUMBER}\s*\])?"
    r'(?:\s*"((?:\\"|[^"\n])*)")?[^\n]*'
)
_PAIRS = r'((?:\s*[-+]?\d{1,20}(?:\.\d*)?\s*"(?:\\"|[^"])*")*)'
_VALUES = re.compile(rf"VAL_\s+{_IDENT}\s+{_NAME}(?:\s+([A-Za-z_]\w*)|{_PAIRS}){_END}")
_VALUES_OF_VARIABLE = re.compile(rf"VAL_\s+[A-Za-z_]\w*{_PAIRS}{_END}")
_TABLE = re.compile(rf"VAL_TABLE_\s+{_NAME}{_PAIRS}{_END}")
_PAIR = re.compile(r'(?<![\d.])([-+]?\d+)(?:\.0*)?\s*"((?:\\"|[^"])*)"')
_COMMENT = re.compile(rf"CM_\s+(?:(?:(SG_)\s+{_IDENT}\s+{_NAME}|(BO_)\s+{_IDENT}|(?:BU_|EV_)\s+\S+)\s*)?{_TEXT}{_END}")
_ATTRIBUTE = re.compile(
    rf'BA_\s+"([^"]*)"\s*(?:(?:(SG_)\s+{_IDENT}\s+{_NAME}|(BO_)\s+{_IDENT}|(?:BU_|EV_)\s+\S+)\s+)?'
    rf"(?:{_NUMBER}|{_TEXT}){_END}"
)
_DEFINITION = re.compile(r'BA_DEF_\s+(?:(?:SG_|BO_|BU_|EV_)\s+)?"([^"]*)"\s*(\w+)((?:"[^"]*"|[^";\n])*)[ \t]*;?')
_DEFAULT = re.compile(rf'BA_DEF_DEF_\s+"([^"]*)"\s*(?:{_NUMBER}|{_TEXT}){_END}')
_KIND = re.compile(rf"SIG_VALTYPE_\s+{_IDENT}\s+{_NAME}\s*:?\s*(\d){_END}")
_RANGES = r"((?:[\s,]*\d{1,10}\s*-\s*\d{1,10})+)"
_SELECTION = re.compile(rf"SG_MUL_VAL_\s+{_IDENT}\s+{_NAME}\s+{_NAME}{_RANGES}{_END}")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")
_WORD = re.compile(r"[A-Za-z_]+(?=[\s:\"]|$)")
_BLANKS = re.compile(r"\s+|//[^\n]*")
_LINE = re.compile(rf"(?:{_TEXT}|[^\"\n])*")
_REST = re.compile(r"[^\n]*")


@dataclass(frozen=True, slots=True)
class Mended:
    """DBC text that cantools reads, and a sentence on its changes, empty without any."""

    text: str
    remark: str
    statements: int  # none: not a DBC at all


@dataclass(slots=True, kw_only=True)
class _Signal:
    name: str
    line: int
    marker: str  # M: multiplexer; m3: selected by its value 3
    layout: str  # start, length, byte order, sign, factor, offset, range, unit
    written: str = ""  # its name in the answer
    kind: str = ""
    values: str = ""
    comment: str = ""
    spn: str = ""  # suspect parameter number of J1939
    selection: tuple[str, str] | None = None  # multiplexer, and ranges of its values


@dataclass(slots=True, kw_only=True)
class _Message:
    name: str
    written: str
    ident: int
    length: int
    signals: dict[str, _Signal] = field(default_factory=dict)
    comment: str = ""
    attributes: dict[str, str] = field(default_factory=dict)


def mended_name(name: str) -> str:
    """Convert a name to letters, digits and underscores, not beginning with a digit, as the format demands."""
    name = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"_{name}" if not name or name[0].isdigit() or name in KEYWORDS else name


def mend(text: str) -> Mended:
    """Rewrite a DBC without its unusable statements."""
    reader = _Reader(text)
    reader.read()
    reader.settle()
    return Mended(reader.written(), reader.remark(), reader.statements)


class _Reader:
    """Reads statements one by one; names and counts refer to the file."""

    def __init__(self, text: str) -> None:
        self.statements = 0
        self._text = text.replace("\r\n", "\n").replace("\r", "\n")
        self._messages: list[_Message] = []
        self._by_ident: dict[str, list[_Message]] = {}
        self._current: _Message | None = None
        self._unassigned: set[str] = set()  # identifiers of messages that are left out
        self._tables: dict[str, str] = {}
        self._formats = FORMATS
        self._defaults: dict[str, str] = {}
        self._late: list[Callable[[], None]] = []  # statements about signals, wherever in the file those are
        self._left_out: Counter[str] = Counter()
        self._changed: Counter[str] = Counter()
        self._first: dict[str, int] = {}  # line of the first one, by kind
        self._line, self._counted_to = 1, 0

    # --- Statements -----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Read all statements of the text."""
        statements: dict[str, tuple[re.Pattern[str], Callable[[re.Match[str]], None], str]] = {
            "BO_": (_MESSAGE, self._take_message, "messages that cannot be read"),
            "SG_": (_SIGNAL, self._take_signal, "signals that cannot be read"),
            "VAL_": (_VALUES, self._take_values, "value tables that cannot be read"),
            "VAL_TABLE_": (_TABLE, self._take_table, "value tables that cannot be read"),
            "CM_": (_COMMENT, self._take_comment, "comments that cannot be read"),
            "BA_": (_ATTRIBUTE, self._take_attribute, ""),
            "BA_DEF_": (_DEFINITION, self._take_definition, ""),
            "BA_DEF_DEF_": (_DEFAULT, self._take_default, ""),
            "SIG_VALTYPE_": (_KIND, self._take_kind, "types of signals that cannot be read"),
            "SG_MUL_VAL_": (_SELECTION, self._take_selection, "multiplexers that cannot be read"),
        }
        at, is_known = 0, True
        last_end = self._text.rfind("*/")  # of a comment in the way of C
        while at < len(self._text):
            if blanks := _BLANKS.match(self._text, at):
                at = blanks.end()
                continue
            if at < last_end and self._text.startswith("/*", at):
                at = self._text.index("*/", at) + 2
                continue
            word = _WORD.match(self._text, at)
            keyword = word[0] if word is not None and word[0] in KEYWORDS else ""
            rest = _REST.match(self._text, at)
            assert rest is not None
            self._count_lines(at)
            if keyword in statements and rest[0].strip() != keyword:  # alone in its line it is one of the list NS_
                pattern, take, kind = statements[keyword]
                self.statements, is_read = self.statements + 1, True
                if match := pattern.match(self._text, at):
                    take(match)
                    at = match.end()
                elif keyword == "VAL_" and (match := _VALUES_OF_VARIABLE.match(self._text, at)):
                    at = match.end()
                else:
                    if keyword == "BO_":
                        self._current = None
                    if kind:
                        self._leave_out(kind)
                    at = rest.end()
                    is_read = False
                is_known = is_read and keyword != "SG_"  # its receivers may go on in the next line
            elif keyword:
                self.statements += 1
                line = _LINE.match(self._text, at)
                at, is_known = max(rest.end(), line.end() if line else 0), False
            else:
                if is_known and rest[0].strip() != ";":
                    self._leave_out("lines that are no statement of a DBC")
                at = rest.end()

    def settle(self) -> None:
        """Apply the statements about signals, then name all signals."""
        for apply in self._late:
            apply()
        for message in self._messages:
            multiplexers = [signal.name for signal in message.signals.values() if signal.marker.endswith("M")]
            for signal in list(message.signals.values()):
                is_selected = signal.marker.startswith("m")
                if is_selected and len(multiplexers) != 1 and signal.selection is None:
                    self._leave_out("multiplexed signals without a multiplexer", signal.line)
                    del message.signals[signal.name]
            self._drop_orphans(message)
            taken: set[str] = set()
            for signal in list(message.signals.values()):
                if signal.written in taken:
                    self._leave_out("signals whose name is another's too", signal.line)
                    del message.signals[signal.name]
                taken.add(signal.written)

    def _drop_orphans(self, message: _Message) -> None:
        """Leave out signals whose multiplexer is left out, and in turn the signals that they multiplex."""
        while orphans := [
            signal
            for signal in message.signals.values()
            if signal.selection is not None and signal.selection[0] not in message.signals
        ]:
            for signal in orphans:
                self._leave_out("multiplexed signals without a multiplexer", signal.line)
                del message.signals[signal.name]

    def _take_message(self, match: re.Match[str]) -> None:
        ident, name, length = match[1], match[2], int(match[3])
        self._current = None
        number = int(ident)
        is_long = bool(number & EXTENDED)
        bits = (number & ~EXTENDED).bit_length()
        if name == UNASSIGNED:
            self._unassigned.add(ident)
        elif bits > EXTENDED_BITS or number >= EXTENDED << 1:
            self._refuse(ident, "messages whose identifier has more than 29 bits")
        elif length > MAX_BYTES:
            self._refuse(ident, f"messages of more than {MAX_BYTES:,} bytes")
        elif any(other.name == name for other in self._by_ident.get(ident, [])):
            self._leave_out("messages that are defined twice")
        else:
            if bits > STANDARD_BITS and not is_long:
                number |= EXTENDED
                self._change("11-bit identifiers that need 29 bits are read as 29-bit ones")
            self._current = _Message(name=name, written=self._named(name), ident=number, length=length)
            self._messages.append(self._current)
            self._by_ident.setdefault(ident, []).append(self._current)

    def _refuse(self, ident: str, kind: str) -> None:
        self._unassigned.add(ident)
        self._leave_out(kind)

    def _take_signal(self, match: re.Match[str]) -> None:
        name, marker, start, length, order, sign, factor, offset, low, high, unit = match.groups()
        if self._current is None:
            return  # its message is counted
        if int(length) == 0 or int(start) + int(length) > MAX_LAYOUT_BITS:
            self._leave_out("signals of no bit, or beyond the end of any message")
        elif name in self._current.signals:
            self._leave_out("signals that are defined twice in their message")
        else:
            scale, span = f"{_number(factor)},{_number(offset)}", f"{_number(low or '0')}|{_number(high or '0')}"
            layout = f'{start}|{length}@{order}{sign} ({scale}) [{span}] "{unit or ""}"'
            marker = "M" if marker == "m" else marker or ""  # selected by no value, so it is a multiplexer itself
            self._current.signals[name] = _Signal(
                name=name, line=self._line, marker=marker, layout=layout, written=self._named(name)
            )

    def _take_values(self, match: re.Match[str]) -> None:
        ident, name, table, pairs = match.groups()

        def apply(signal: _Signal) -> None:
            signal.values = self._tables.get(table, "") if table else _pairs(pairs)

        self._defer(ident, name, "value tables of signals that do not exist", apply)

    def _take_table(self, match: re.Match[str]) -> None:
        self._tables[match[1]] = _pairs(match[2])

    def _take_comment(self, match: re.Match[str]) -> None:
        _, ident, name, _, of_message, text = match.groups()

        def apply(target: _Signal | _Message) -> None:
            target.comment = text

        if ident is not None:
            self._defer(ident, name, "comments of signals that do not exist", apply)
        elif of_message is not None:
            self._of_message(of_message, "comments of messages that do not exist", apply)

    def _take_attribute(self, match: re.Match[str]) -> None:
        attribute, _, ident, name, _, of_message, number, text = match.groups()
        value = number if number is not None else text

        def rename(target: _Signal | _Message) -> None:
            target.written = mended_name(value) if value else target.written

        def number_signal(signal: _Signal) -> None:
            signal.spn = value if value.isdecimal() and len(value) <= MAX_SPN_DIGITS else ""

        def set_attribute(message: _Message) -> None:
            message.attributes[attribute] = value

        if ident is not None:
            apply: Callable[[_Signal], None] = rename if attribute in LONG_NAMES else lambda signal: None
            apply = number_signal if attribute == SPN else apply
            self._defer(ident, name, "attributes of signals that do not exist", apply)
        elif of_message is not None:
            set_or_rename = rename if attribute in LONG_NAMES else set_attribute
            self._of_message(of_message, "attributes of messages that do not exist", set_or_rename)

    def _take_definition(self, match: re.Match[str]) -> None:
        if match[1] == FORMAT and match[2] == "ENUM":
            self._formats = re.findall(r'"([^"]*)"', match[3]) or FORMATS

    def _take_default(self, match: re.Match[str]) -> None:
        self._defaults[match[1]] = match[2] if match[2] is not None else match[3]

    def _take_kind(self, match: re.Match[str]) -> None:
        ident, name, kind = match.groups()

        def apply(signal: _Signal) -> None:
            signal.kind = kind if kind in "12" else ""  # IEEE float, double; 0 and 3 are integers

        self._defer(ident, name, "types of signals that do not exist", apply)

    def _take_selection(self, match: re.Match[str]) -> None:
        ident, name, multiplexer, ranges = match.groups()
        spans = [(int(low), int(high)) for low, high in _RANGE.findall(ranges)]
        if sum(high - low + 1 for low, high in spans) > MAX_SELECTING:
            self._leave_out(f"multiplexers that select a signal by more than {MAX_SELECTING:,} values")
            return

        def apply(signal: _Signal) -> None:
            signal.selection = (multiplexer, ", ".join(f"{low}-{high}" for low, high in spans))

        self._defer(ident, name, "multiplexed signals that do not exist", apply)

    def _defer(self, ident: str, name: str, kind: str, apply: Callable[[_Signal], None]) -> None:
        """Register a statement to be applied to a signal once all signals are read."""
        line = self._line

        def late() -> None:
            signals = [m.signals[name] for m in self._by_ident.get(ident, []) if name in m.signals]
            for signal in signals:
                apply(signal)
            if not signals and ident not in self._unassigned:
                self._leave_out(kind, line)

        self._late.append(late)

    def _of_message(self, ident: str, kind: str, apply: Callable[[_Message], None]) -> None:
        line = self._line

        def late() -> None:
            for message in self._by_ident.get(ident, []):
                apply(message)
            if ident not in self._by_ident and ident not in self._unassigned:
                self._leave_out(kind, line)

        self._late.append(late)

    # --- What is said of it ---------------------------------------------------------------------------------------

    def _named(self, name: str) -> str:
        written = mended_name(name)
        if written != name:
            self._change("names that begin with a digit or have other signs are mended")
        return written

    def _leave_out(self, kind: str, line: int | None = None) -> None:
        self._left_out[kind] += 1
        self._first.setdefault(kind, self._line if line is None else line)

    def _change(self, kind: str) -> None:
        self._changed[kind] += 1
        self._first.setdefault(kind, self._line)

    def _count_lines(self, at: int) -> None:
        self._line += self._text.count("\n", self._counted_to, at)
        self._counted_to = at

    def remark(self) -> str:
        """Sentence on the statements left out and changed: number by kind, and line of the first."""
        parts = []
        for what, counts in (("left out", self._left_out), ("changed", self._changed)):
            kinds = [
                f"{kind} ({count:,}, {'first in ' if count > 1 else ''}line {self._first[kind]})"
                for kind, count in counts.items()
            ]
            if kinds:
                parts.append(f"{what}: {', '.join(kinds)}")
        return "; ".join(parts)

    # --- The regular form -----------------------------------------------------------------------------------------

    def written(self) -> str:
        """The messages as a DBC."""
        out = ['VERSION ""', "BS_:", "BU_:"]
        for message in self._messages:
            out.append(f"BO_ {message.ident} {message.written}: {message.length} Vector__XXX")
            for signal in message.signals.values():
                out.append(f" SG_ {f'{signal.written} {signal.marker}'.strip()} : {signal.layout} Vector__XXX")
        out += [f'BA_DEF_ {kind} "{ORIGINAL_NAME}" STRING ;' for kind in ("BO_", "SG_")]
        out.append(f'BA_DEF_ SG_ "{SPN}" INT 0 524287;')
        out += self._cycles_and_formats()
        for message in self._messages:
            out += _about_message(message)
            for signal in message.signals.values():
                out += _about_signal(message, signal)
        return "\n".join(out) + "\n"

    def _cycles_and_formats(self) -> list[str]:
        """Definitions of the attributes that are used, and their values where no message has its own."""
        formats = ",".join(f'"{name}"' for name in FORMATS)
        out = [
            f'BA_DEF_ BO_ "{CYCLE}" FLOAT 0 1e9;',
            f'BA_DEF_ BO_ "{FORMAT}" ENUM {formats};',
            f'BA_DEF_DEF_ "{FORMAT}" "{self._format(self._defaults.get(FORMAT, ""))}";',
        ]
        if (cycle := self._defaults.get(CYCLE)) and re.fullmatch(_NUMBER, cycle):
            out.append(f'BA_DEF_DEF_ "{CYCLE}" {_number(cycle)};')
        for message in self._messages:
            if (cycle := message.attributes.get(CYCLE)) and re.fullmatch(_NUMBER, cycle):
                out.append(f'BA_ "{CYCLE}" BO_ {message.ident} {_number(cycle)};')
            if (value := message.attributes.get(FORMAT)) is not None:
                out.append(f'BA_ "{FORMAT}" BO_ {message.ident} {FORMATS.index(self._format(value))};')
        return out

    def _format(self, value: str) -> str:
        """The name of a frame format, given by name or by its place among those that the file defines."""
        name = self._formats[int(value)] if value.isdecimal() and int(value) < len(self._formats) else value
        return name if name in FORMATS else FORMATS[0]


def _about_message(message: _Message) -> list[str]:
    out = []
    if message.written != message.name:
        out.append(f'BA_ "{ORIGINAL_NAME}" BO_ {message.ident} "{message.name}";')
    if message.comment:
        out.append(f'CM_ BO_ {message.ident} "{message.comment}";')
    return out


def _about_signal(message: _Message, signal: _Signal) -> list[str]:
    path = f"{message.ident} {signal.written}"
    out = []
    if signal.written != signal.name:
        out.append(f'BA_ "{ORIGINAL_NAME}" SG_ {path} "{signal.name}";')
    if signal.spn:
        out.append(f'BA_ "{SPN}" SG_ {path} {int(signal.spn)};')
    if signal.kind:
        out.append(f"SIG_VALTYPE_ {path} : {signal.kind};")
    if signal.values:
        out.append(f"VAL_ {path} {signal.values} ;")
    if signal.comment:
        out.append(f'CM_ SG_ {path} "{signal.comment}";')
    if signal.selection is not None:
        multiplexer, ranges = signal.selection
        out.append(f"SG_MUL_VAL_ {path} {message.signals[multiplexer].written} {ranges};")
    return out


def _number(text: str) -> str:
    """A number as cantools reads it: with a digit before its point."""
    return re.sub(r"^([-+]?)\.", r"\g<1>0.", text)


def _pairs(text: str) -> str:
    """Values and their names."""
    return " ".join(f'{int(number)} "{name}"' for number, name in _PAIR.findall(text))
