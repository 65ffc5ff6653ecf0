/* What replay.c offers to a program that runs it, here or on another processor. */
#ifndef REPLAY_H
#define REPLAY_H

#include <stdint.h>

#define REPLAY_ROUNDS 2000u

void replay_begin(void);
void replay_command(void); /* COMMANDs and their REPLYs */
void replay_tick(void);    /* one control period */
void replay_current(void); /* one step of the current loop */
void replay_report(void);  /* one REPORT, to its bytes */
uint32_t replay_sum(void);

#endif
