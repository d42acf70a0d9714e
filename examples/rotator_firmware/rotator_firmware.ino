// Turns a polarizer's ring by a stepper behind a STEP/DIR driver (A4988, DRV8825, TMC2209), told so over USB.
// For Arduino AVR and RP2040 (arduino-pico). Protocol `polcap-rotator 1`: see the reference page on rotators.
// In: ? | home | zero | go DEGREES | where | stop        Out: ok DEGREES | busy DEGREES | error TEXT

const char NAME[] = "stepper";           // one word; stands in capture.toml
const float STEPS_PER_DEGREE = 26.6667;  // 200 steps × 16 microsteps × gear 3 ÷ 360
const float SPEED = 60.0;                // degrees/s; there is no ramp, so one the motor can start at
const int STEP_PIN = 2, DIR_PIN = 3, ENABLE_PIN = 4;  // enable is active low
const int SWITCH_PIN = 5;                // to ground at zero; -1 without, then use home=ask in polcap's URL
const bool UP = HIGH;                    // level of DIR_PIN that turns towards larger angles

enum Motion { STANDS, GOES, LEAVES_SWITCH, SEEKS_SWITCH };
Motion motion = STANDS;
bool homed = false;
long at = 0, target = 0, sought = 0;     // steps
unsigned long stepped = 0, told = 0;     // µs, ms
char command[32];
unsigned int length = 0;

void say(const char *word) {
  Serial.print(word);
  Serial.print(' ');
  Serial.println(at / STEPS_PER_DEGREE, 3);
  told = millis();
}

void fail(const char *text) {
  Serial.print("error ");
  Serial.println(text);
}

void hello(const char *more) {
  Serial.print("polcap-rotator 1 ");
  Serial.print(NAME);
  Serial.print(' ');
  Serial.print(SPEED, 1);
  Serial.println(more);
}

void release() {  // a free ring may be turned by hand: zero is forgotten
  digitalWrite(ENABLE_PIN, HIGH);
  motion = STANDS;
  homed = false;
}

void start(Motion how) {
  digitalWrite(ENABLE_PIN, LOW);
  motion = how;
  told = millis();
}

void arrive() {
  motion = STANDS;
  say("ok");
}

void zero() {
  digitalWrite(ENABLE_PIN, LOW);
  at = target = 0;
  homed = true;
  arrive();
}

bool at_switch() { return digitalRead(SWITCH_PIN) == LOW; }

void step_towards(bool up) {
  digitalWrite(DIR_PIN, up ? UP : !UP);
  digitalWrite(STEP_PIN, HIGH);
  delayMicroseconds(3);
  digitalWrite(STEP_PIN, LOW);
  at += up ? 1 : -1;
}

void advance() {
  if (motion == GOES) {
    if (at == target) return arrive();
    return step_towards(target > at);
  }
  if (motion == LEAVES_SWITCH && !at_switch()) motion = SEEKS_SWITCH;
  if (motion == SEEKS_SWITCH && at_switch()) return zero();
  if (++sought > 400 * STEPS_PER_DEGREE) {
    release();
    return fail("the switch was not found in 400 degrees; check its wiring");
  }
  step_towards(motion == LEAVES_SWITCH);
}

void obey() {
  if (!strcmp(command, "?")) return hello("");
  if (!strcmp(command, "stop")) return release(), say("ok");
  if (!strcmp(command, "zero")) return zero();
  if (!strcmp(command, "home")) {
    if (SWITCH_PIN < 0) return fail("there is no switch; use home=ask");
    homed = false;
    sought = 0;
    return start(at_switch() ? LEAVES_SWITCH : SEEKS_SWITCH);
  }
  if (strncmp(command, "go ", 3) && strcmp(command, "where")) return fail("unknown command");
  if (!homed) return fail("home first");
  if (command[0] == 'w') return say("ok");
  char *end;
  double degrees = strtod(command + 3, &end);
  if (end == command + 3 || *end || !(degrees > -1000 && degrees < 1000)) return fail("no angle");
  target = lround(degrees * STEPS_PER_DEGREE);
  start(GOES);
}

void setup() {
  pinMode(STEP_PIN, OUTPUT);
  pinMode(DIR_PIN, OUTPUT);
  pinMode(ENABLE_PIN, OUTPUT);
  if (SWITCH_PIN >= 0) pinMode(SWITCH_PIN, INPUT_PULLUP);
  release();
  Serial.begin(115200);
  hello(" started");
}

void loop() {
  while (Serial.available()) {
    char letter = Serial.read();
    if (letter == '\n') {
      command[length] = 0;
      if (length) obey();
      length = 0;
    } else if (letter != '\r' && length < sizeof(command) - 1) {
      command[length++] = letter;
    }
  }
  if (motion != STANDS && micros() - stepped >= 1e6 / (SPEED * STEPS_PER_DEGREE)) {
    stepped = micros();
    advance();
  }
  if (motion != STANDS && millis() - told >= 500) say("busy");
}
