"""Words in the names of signals and messages that speak for a role, or against it: regular expressions.

They are those of public DBC files, English and German. Names are in lower case, with a blank between words.
"""

from dataclasses import dataclass

from estimator.signals import Role

_WHEEL = r"(wheel|whl|wss|rad(?=geschw|drehz|[vh][lr]|_0)|(?<![a-z])(fl|fr|rl|rr|lf|rf|lr)(?![a-z]))"
CORNER = (
    r"(?<![a-z])(fl|fr|rl|rr|lf|rf|lr|vl|vr|hl|hr|front left|front right|rear left|rear right|"
    r"left front|right front|left rear|right rear)(?![a-z])"
)
COMMAND = (
    r"(command|commanded|cmd|request|requested|req|rq|target|tgt|set ?point|desired|limit|limiting|"
    r"max|min|maximum|minimum|mx|mn|lim|charge|chrg|dchrg|available|allowed|demand|set|rated|rating|rel|relative|"
    r"assist|lka|lkas|wish|wunsch\w*|"
    r"demanded|error|fault|diag|counter|checksum|crc|valid|quality|accuracy|status|enable|mode|offset|calibration|"
    r"soll\w*|cruise|acc|lead|obj|object|radar|hud|display|dash|raw|delta|slip|trailer|steer|steering|eps|driver)"
)
ELSEWHERE = (  # names of messages about other things than the vehicle and its drive
    r"(steer\w*|eps|epas|pscm|mdps|lka\w*|hca|scc|fca|aeb|tsr|radar|srr|track|object|obj|camera|"
    r"dcdc|charg\w*|compressor|klima|hvac|seat|door|trailer|twelve|rating|limits?|commands?|requests?)"
)


@dataclass(frozen=True, slots=True)
class Words:
    """Patterns of names, spaced and in lower case, for and against a role."""

    role: Role
    like: str  # any of them names the role
    unlike: str  # any of them is of something else


WORDS = [
    Words(
        Role.SPEED,
        r"(wheel ?based ?vehicle ?speed|vehicle ?speed|vitesse ?vehicule( roues)?|"
        r"veh ?spd|veh(icle)? ?v(el)?|vehicle velocity|v ?ego|v ?veh|speed vehicle|"
        r"ground ?speed|car ?speed|"
        r"xmission ?speed|speed|spd|geschwindigkeit|fahrgeschw|velocity)",
        rf"({_WHEEL}|engine|motor|rpm|fan|wind|wiper|gps|sat|turbine|shaft|yaw|angular|input|output|pump|"
        rf"mean|av|idle|inv|axle|trap|sign|tsr|navi|wind|"
        r"inverter|angle|lateral|lat|long|rad s)",
    ),
    Words(
        Role.WHEEL_SPEEDS,
        rf"({_WHEEL}.*(speed|spd|vel|kph|geschw|drehz)|(speed|spd|vel).*{_WHEEL})",
        r"(motor|inv|rpm|mean|rad s)",
    ),
    Words(
        Role.ENGINE_POWER,
        r"((motor|engine|eng|inv|drive|wheel|traction|mech|shaft) ?(power|pwr|leistung)|power)",
        r"(steering|heater|aircond|air conditioner|ac|hvac|dcdc|dc dc|charg|brake|window|reactive|supply|"
        r"key|battery|lv|aux|generator|compressor|light|heat|waste|optimal|ideal|consumption|clima|climate)",
    ),
    Words(
        Role.ENGINE_TORQUE,
        r"((engine|eng|motor|mot|mo|inv|drive|fast|effective|mg)? ?"
        r"(mom(ent)? ?ist( summe)?|istmoment|(torque|trq|tq|moment|drehmoment)"
        r"( ?feedback| ?actual| ?act( out)?| ?estimate| ?est)?))",
        r"(brake|brk|brems\w*|wheel|whl|rad|lenk\w*|friction|loss|lost|lss|verlust\w*|verbraucher|hv|acn|wank|"
        r"gradient|shudder|reference|converter|regen|adjustment|clutch|"
        r"percent|pct|fraction|stnd|std|4 wd|wd|tqc)",
    ),
    Words(
        Role.ENGINE_SPEED,
        r"((engine|eng|motor|mot|inv|drive|mg)( ?output)? ?(speed|spd|rpm|n(?![a-z])|rev\w*)|rpm|n ?(mot|eng)|^n$|"
        r"axle ?speed|motordrehzahl|drehzahl)",
        rf"({_WHEEL}|fan|turbine|compressor|pump|idle|output|input|shaft|mean|blower)",
    ),
    Words(
        Role.TORQUE_FRACTION,
        r"(actual ?eng(ine)? ?percent ?torque|(torque|tq ?i?|trq).*(percent|pct|fraction)|(percent|"
        r"pct).*(torque|trq)|tqi)",
        r"(friction|loss|fractional|reference|retarder|nominal)",
    ),
    Words(
        Role.FRICTION_FRACTION, r"(friction.*(percent|pct)?.*(torque|tq)|tqfr|tq ?fr)", r"(brake|clutch|coefficient)"
    ),
    Words(Role.REFERENCE_TORQUE, r"(reference ?torque|torque ?ref(erence)?|tq ?stn?d|tqn)", r"(percent)"),
    Words(
        Role.BRAKE_SWITCH,
        r"(brake ?(pedal)? ?(switch|pressed|applied|act(ive)?|light ?switch|on|state|lamp|lights|status)|"
        r"brk ?(sw|act|on)|bls|bremse ?betaetigt|bremslicht|(?<![a-z])brake(?![a-z])|"
        r"driver ?brake ?apply)",
        r"(park|pbrake|p brake|epb|hand|pressure|press$|temp|fuse|channel|hold|regen|abs|fluid|pad|wear|"
        r"auto|emergency|aeb|fcw|while|warning|power brake)",
    ),
    Words(
        Role.BRAKE_PEDAL,
        r"(brake ?(pedal)? ?(position|pos|percent|travel|pct|way)|brk ?ped ?(pos|pct))",
        r"(park|pressure|regen)",
    ),
    Words(
        Role.GEAR,
        r"(current ?gear|act(ual)? ?gear|gear ?(actual|act|engaged|number|pos)?|trans ?gear|gang)",
        r"(shift|lever|selector|shifter|target|reverse|ratio|steering|knob|display|park)",
    ),
    Words(
        Role.CLUTCH_SWITCH,
        r"(clutch ?(switch|pedal|pressed|depressed|sw|act)?|kupplung)",
        r"(torque|lock|temp|fan|pressure|air ?cond|ac|slip)",
    ),
    Words(Role.PARK_BRAKE, r"((park(ing)?|hand|e?p) ?brake|epb|handbremse)", r"(temp|force|clamp|voltage)"),
    Words(Role.ALTITUDE, r"(altitude|elevation|hoehe|msl)", r"(suspension|chassis|ride|headlight|seat|air ?spring)"),
    Words(
        Role.GRADE,
        r"(grade|slope|incline|inclination|road ?gradient|steigung)",
        r"(fuel|torque|tq|pressure|colou?r|offset|oil|est\w*)",
    ),
    Words(
        Role.GRADE_REFERENCE,
        r"((grade|slope|inclination|road ?gradient) ?est\w*|est\w* ?(road ?)?(grade|slope|inclination|gradient))",
        r"(fuel|torque|tq|pressure|internal)",
    ),
    Words(
        Role.MASS_REFERENCE,
        r"((est\w* )?(vehicle|veh|gross|gross ?vehicle|gross ?combination( ?vehicle)?|total|car|truck)? ?"
        r"(mass|weight)( ?est\w*)?|fahrzeugmasse|(?<![a-z])masse)",
        r"(air|luft|flow|fuel|kraftstoff|soot|ash|axle|seat|occupant|passenger|confidence|cell|gradient|trailer)",
    ),
    Words(
        Role.LONGITUDINAL_ACCELERATION,
        r"(long(itudinal|it|l)? ?(acc(el(eration)?)?)|accel(eration)? ?(x|long)|acc ?x|ax|laengsbeschl)",
        r"(lat|cruise|pedal|limit)",
    ),
    Words(
        Role.LATERAL_ACCELERATION,
        r"(lat(eral)? ?(acc(el(eration)?)?)|accel(eration)? ?(y|lat)|acc ?y|querbeschl)",
        r"(long)",
    ),
    Words(Role.YAW_RATE, r"(yaw ?(rate|rt|vel|speed)?|gierrate)", r"(angle|accel|torque)"),
    Words(Role.HEADING, r"(heading|compass ?bearing|course|bearing)", r"(error|warning)"),
    Words(Role.GPS_SPEED, r"((gps|gnss|sat|nav(igation)?).*(speed|velocity|vel))", r"(vertical|up|north|east|down)"),
    Words(Role.LATITUDE, r"latitude", r"(minutes|direction|hemisphere|north)"),
    Words(Role.LONGITUDE, r"longitude", r"(minutes|direction|hemisphere|east)"),
    Words(
        Role.AMBIENT_TEMPERATURE,
        r"((ambient|outside|outdoor|external|exterior|out|amb).*(temp|temperature|tmp|te)|aussentemp)",
        r"(battery|coolant|cabin|seat|cell)",
    ),
    Words(
        Role.AIR_PRESSURE,
        r"(baro(metric)? ?(pressure|press)?|ambient ?(air)? ?press(ure)?|atmospheric|luftdruck)",
        r"(tire|tyre|boost)",
    ),
    Words(
        Role.COOLANT_TEMPERATURE,
        r"(coolant ?(temp)?|eng(ine)? ?(coolant|cool)? ?temp(erature)?|kuehlmittel)",
        r"(battery|inverter|heater|cabin|oil)",
    ),
    Words(Role.FAN_SPEED, r"((radiator|cooling|engine)? ?fan ?(speed|spd|rpm))", r"(cabin|blower|hvac|seat)"),
    Words(Role.RETARDER_FRACTION, r"(retarder.*(torque|percent)|actual ?retarder)", r"(reference|selection)"),
    Words(
        Role.BATTERY_VOLTAGE,
        r"((?<![a-z])[uv] ?bat(t(ery)?)?|(hv|lb|pack|traction|trac|bat(t(ery)?)?|dc ?bus|bus|shunt|ivt|bms)"
        r".*(volt(age)?|(?<![a-z])u(?![a-z])|"
        r"(?<![a-z])v(?![a-z]))|dc ?bus ?voltage)",
        r"(cell|12 ?v|lv|lo|ulo|low|aux|motor|phase|charger|sensor|snsr|ref|hist|wave)",
    ),
    Words(
        Role.BATTERY_CURRENT,
        r"((?<![a-z])i ?bat(t(ery)?)?|(hv|lb|pack|traction|trac|bat(t(ery)?)?|dc ?bus|bus|shunt|ivt|bms)"
        r".*(current|curr|amps?|"
        r"(?<![a-z])i(?![a-z]))|dc ?bus ?current)",
        r"(cell|12 ?v|v ?12|lv|lo|ulo|low|aux|motor|phase|charger|brake|light|channel|fan|pump|snsr|hist|integrated)",
    ),
]
