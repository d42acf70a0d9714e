"""The rig: a motor that turns the polarizer and a camera, driven and watched.

In: a port, a camera, a list of angles. Out: a capture folder. Angles are in degrees throughout, as devices speak them.

    sequence         angles × bracket -> capture folder, frame by frame
    plan             an order -> its frames, the shortest way through the angles, the time it takes
    landing          photographs -> saved and judged in the background
    frame_check      one frame as it lands -> what is wrong with it
    record           good and bad frames -> rig.json, capture.toml
    preview          the middle exposures -> a first look at the polarization
    camera           what every camera does
    camera_choice    by name -> one of
        camera_gphoto2   a body on a cable
        camera_folder    any application that writes RAWs into a folder
    rotator          what a rotator does, and how every motor is driven; by URL -> one of
        elliptec         Thorlabs ELL14, ELL18
        grbl             a stepper behind GRBL 1.1
        line_protocol    an Arduino or RP2040 with the sketch of `examples/rotator_firmware`
        manual           a person at the terminal
    simulated        the camera and the motor that need no hardware
    watchdog         a call that may hang -> its answer, or an error in time
    serial_port      a line-based exchange over a serial port; alone knows pyserial
    log              every command sent and answered -> a text file
"""
