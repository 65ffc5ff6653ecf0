/* For hosts that load the firmware as a shared library: sizes of what they allocate. Not part of a board's image. */
#include "aw_current.h"
#include "aw_encoder_board.h"
#include "aw_motor_board.h"

size_t aw_size_of_current(void);
size_t aw_size_of_encoder_board(void);
size_t aw_size_of_encoder_setup(void);
size_t aw_size_of_encoder_inputs(void);
size_t aw_size_of_motor_board(void);
size_t aw_size_of_motor_setup(void);
size_t aw_size_of_motor_inputs(void);
size_t aw_size_of_can_frame(void);

size_t aw_size_of_current(void)
{
    return sizeof(aw_current_t);
}

size_t aw_size_of_encoder_board(void)
{
    return sizeof(aw_encoder_board_t);
}

size_t aw_size_of_encoder_setup(void)
{
    return sizeof(aw_encoder_setup_t);
}

size_t aw_size_of_encoder_inputs(void)
{
    return sizeof(aw_encoder_inputs_t);
}

size_t aw_size_of_motor_board(void)
{
    return sizeof(aw_motor_board_t);
}

size_t aw_size_of_motor_setup(void)
{
    return sizeof(aw_motor_setup_t);
}

size_t aw_size_of_motor_inputs(void)
{
    return sizeof(aw_motor_inputs_t);
}

size_t aw_size_of_can_frame(void)
{
    return sizeof(aw_can_frame_t);
}
