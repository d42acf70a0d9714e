"""The rig: a motor that turns the polarizer and a camera, driven and watched.

In: a port, a camera, a list of angles. Out: a capture folder. Angles are in degrees throughout, as devices speak them.

    sequence         angles × bracket -> capture folder, frame by frame
    frames           one frame as it lands -> what is wrong with it
    camera           what a camera does; by name -> one of
        camera_gphoto2   a body on a cable
        camera_folder    any application that writes RAWs into a folder
    rotator          what a rotator does, and how every motor is driven; by URL -> one of
        elliptec         Thorlabs ELL14, ELL18
        grbl             a stepper behind GRBL 1.1
        line             an Arduino or RP2040 with the sketch of `examples/rotator_firmware`
        manual           a person at the terminal
    simulated        the camera and the motor that need no hardware
    transport        a line-based exchange over a serial port; alone knows pyserial
    log              every command sent and answered -> a text file
"""
