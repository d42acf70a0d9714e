// What examples/rotator_firmware needs of an Arduino, on a computer: serial is stdin and stdout, the ring a counter.
// argv[1]: initial position of the ring, argv[2]: position at which its switch closes [steps]. At its release, the
// position is written to stderr.
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { LOW, HIGH, INPUT_PULLUP, OUTPUT };
static long ring, switch_at;
static bool upwards;

static double now() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}
unsigned long micros() { return (unsigned long)(1e6 * now()); }
unsigned long millis() { return (unsigned long)(1e3 * now()); }
void delayMicroseconds(int) {}
void pinMode(int, int) {}
int digitalRead(int) { return ring <= switch_at ? LOW : HIGH; }
void digitalWrite(int pin, int level) {  // the sketch's pins: 2 step, 3 direction, 4 enable
  if (pin == 3) upwards = level == HIGH;
  if (pin == 2 && level == HIGH) ring += upwards ? 1 : -1;
  if (pin == 4 && level == HIGH) fprintf(stderr, "released %ld\n", ring);
}

struct {
  void begin(long) {}
  bool available() {
    pollfd p = {0, POLLIN, 0};
    return poll(&p, 1, 0) > 0;
  }
  char read() {
    char letter;
    if (::read(0, &letter, 1) != 1) exit(0);
    return letter;
  }
  void print(char letter) {
    char text[] = {letter, 0};
    print(text);
  }
  void print(const char *text) {
    if (write(1, text, strlen(text)) < 0) exit(0);
  }
  void println(const char *text) { print(text), print("\r\n"); }
  void print(double number, int digits) {
    char text[32];
    snprintf(text, sizeof text, "%.*f", digits, number);
    print(text);
  }
  void println(double number, int digits) { print(number, digits), print("\r\n"); }
} Serial;

void setup();
void loop();
int main(int, char **argv) {
  ring = atol(argv[1]), switch_at = atol(argv[2]);
  for (setup();; usleep(20)) loop();
}
