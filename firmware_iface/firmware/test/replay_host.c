/* The conversation of replay.c on this machine. */
#include <stdio.h>

#include "replay.h"

int main(void)
{
    replay_begin();
    for (uint32_t round = 0u; round < REPLAY_ROUNDS; round++) {
        replay_command();
        replay_tick();
        replay_tick();
        replay_current();
        replay_report();
    }
    (void)printf("sum %08lx\n", (unsigned long)replay_sum());
    return 0;
}
