/* SPDX-License-Identifier: MIT-0 */
/* markov_jump_selftest_main.c: exit status 0 if markov_jump_selftest() passes on this machine. */
#include "markov_jump.h"

int main(void)
{
    return (markov_jump_selftest() == MARKOV_JUMP_OK) ? 0 : 1;
}
