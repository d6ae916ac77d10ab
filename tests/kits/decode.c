/* Reads the status block and the latest parcel as numbers, prints what config/kits/c/beltgauge.h makes of them. */
#include "beltgauge.h"

#include <stdio.h>

static void tell(const char *name, double value)
{
    printf("%s %.9g\n", name, value);
}

int main(void)
{
    uint16_t registers[BELTGAUGE_AT_LATEST + BELTGAUGE_PARCEL_REGISTERS];
    for (unsigned i = 0; i < sizeof registers / sizeof *registers; i++) {
        unsigned number;
        if (scanf("%u", &number) != 1) {
            return 1;
        }
        registers[i] = (uint16_t)number;
    }
    beltgauge_status status = beltgauge_decode_status(&registers[BELTGAUGE_AT_STATUS_BLOCK]);
    beltgauge_parcel parcel = beltgauge_decode_parcel(&registers[BELTGAUGE_AT_LATEST]);
    tell("is_known", beltgauge_is_known(registers));
    tell("running", (status.status & BELTGAUGE_STATUS_BIT_RUNNING) != 0);
    tell("belt_seen_mm_per_s", (double)status.belt_seen_mm_per_s);
    tell("light_change_percent", status.light_change_percent);
    tell("next_ticket", beltgauge_next_ticket(registers[BELTGAUGE_AT_TICKET_DONE]));
    tell("is_whole", beltgauge_is_whole(&parcel));
    tell("may_be_used", beltgauge_may_be_used(&parcel));
    tell("is_box", beltgauge_shape_of(&parcel) == BELTGAUGE_SHAPE_BOX);
    tell("by_encoder", (parcel.valid & BELTGAUGE_VALID_BY_ENCODER) != 0);
    tell("sequence", parcel.sequence);
    tell("clipped", (parcel.flags & BELTGAUGE_FLAG_CLIPPED) != 0);
    tell("merged", (parcel.flags & BELTGAUGE_FLAG_MERGED) != 0);
    tell("length_mm", (double)parcel.length_mm);
    tell("width_mm", (double)parcel.width_mm);
    tell("height_mm", (double)parcel.height_mm);
    tell("yaw_deg", (double)parcel.yaw_deg);
    tell("x_mm", (double)parcel.x_mm);
    tell("y_mm", (double)parcel.y_mm);
    tell("sigma_length_mm", (double)parcel.sigma_length_mm);
    tell("sigma_width_mm", (double)parcel.sigma_width_mm);
    tell("sigma_height_mm", (double)parcel.sigma_height_mm);
    tell("quality_length_percent", parcel.quality_length_percent);
    tell("quality_width_percent", parcel.quality_width_percent);
    tell("quality_height_percent", parcel.quality_height_percent);
    tell("belt_speed_mm_per_s", parcel.belt_speed_10_per_mm_per_s / 10.0);
    tell("frame", parcel.frame);
    tell("time_ms", parcel.time_ms);
    tell("not_measured", parcel.not_measured);
    tell("x_now_mm", (double)beltgauge_x_now_mm(&parcel, &status));
    tell("ring_address", beltgauge_ring_address(parcel.sequence));
    return 0;
}
