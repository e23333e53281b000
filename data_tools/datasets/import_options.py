"""Help of the options that say how a table is read, for all commands that have them."""

COLUMNS = (
    "Names of columns in the file, where they are not found: time=ts_ns,x=pos_x,yaw=hdg. `length=` leaves one out."
)
CLASSES = "Names of classes: REGULAR_VEHICLE=car,PERSON=pedestrian. `SIGN=` leaves a class out."
UNITS = (
    "Units: time=ns (s, ms, us, ns, iso8601, 10Hz), length=ft (m, cm, mm, km, ft), speed=km/h (m/s, km/h, mph, "
    "ft/s), angle=deg (rad, deg; clockwise, clockwise_deg; compass, compass_rad: clockwise from north), score=percent "
    "(share, percent). Of one column: yaw=deg."
)
COORDINATES = (
    "Coordinates of rows that say none; all but world need the pose of the vehicle. camera: at its origin, x to the "
    "right, y down, z ahead.  [default: world]"
)
SORT = "Sort the rows by time, in memory."
AS_GIVEN = "Read the table as it is said to be, even where its contents contradict it."
IMPORT = "YAML file with the same: columns, classes, units, coordinates, sort, as_given."
