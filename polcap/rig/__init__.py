"""The rig: a motor turns the polarizer, a camera takes the brackets, and the frames become a capture folder.

Angles are in degrees throughout, as the devices use them.

    sequence                turn, take the missing frames, check in the background
    turntable               the views of an object from all sides, each a sequence
    exposure_bracket        `--bracket`, and the default exposures
    shooting_plan           every frame, in the order that turns the motor least
    dry_run                 the time that a plan takes
    background_check        save and check photographs while the rig goes on
    retake_criteria         which frame is retaken, and why
    capture_record          accepted and rejected frames: rig.json, capture.toml
    resume                  options and record of the begun capture
    preview                 first picture of the polarization

    device_urls             opens the rotator or camera that a URL names
    rotator                 zero, sense, one-sided approach and read-back; the protocol `Motor` of all drivers
    motor_elliptec_ell14    Thorlabs ELL14, ELL18
    motor_grbl              a stepper on a GRBL 1.1 board
    motor_line_protocol     an Arduino or RP2040 with the sketch of `examples/rotator_firmware`
    motor_by_hand           a person turns the ring or the board
    motor_simulated         no hardware
    serial_port             lines of text over a serial port, with timeouts
    camera                  the protocol `Camera` of all drivers
    camera_gphoto2          a camera on a USB cable
    camera_watch_folder     a tethering program writes RAWs into a folder
    camera_simulated        no hardware
    person                  questions at the terminal
    device_log              every command and every answer: rig.log
"""
