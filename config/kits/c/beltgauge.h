/* Beltgauge, register map 2.0, for C99. Printed from the tables in src/plc: do not edit.
 *
 * Read the registers with any Modbus library into an array of uint16_t. Check the first registers with
 * beltgauge_is_known() after every connect, then decode. Addresses are those of modbus.base_address = 0.
 * The header needs no library, takes no memory and keeps no state. */
#ifndef BELTGAUGE_H
#define BELTGAUGE_H

#include <stdbool.h>
#include <stdint.h>

#define BELTGAUGE_MAP_MAJOR 2u
#define BELTGAUGE_PARCEL_REGISTERS 32u /* of one parcel */
#define BELTGAUGE_RING_PARCELS 32u
#define BELTGAUGE_STATUS_REGISTERS 83u /* of the status block, at most 125 in one request */

/* Where blocks begin. Parcels: the latest one, the oldest that waits to be acknowledged, the last 32. */
enum {
    BELTGAUGE_AT_STATUS_BLOCK = 0,
    BELTGAUGE_AT_COMMAND_BLOCK = 60,
    BELTGAUGE_AT_LATEST = 100,
    BELTGAUGE_AT_QUEUE = 140,
    BELTGAUGE_AT_RING = 200
};

/* Where the values of the status block are: value = register / scale. */
enum {
    BELTGAUGE_AT_IDENTITY = 0, /* U16, constant 0x4247, "BG" */
    BELTGAUGE_AT_MAP_VERSION = 1, /* U16, major in the high byte, minor in the low */
    BELTGAUGE_AT_TEST_U32 = 2, /* U32, constant 0x12345678: checks the word order */
    BELTGAUGE_AT_TEST_I16 = 4, /* I16, constant -12345: checks the sign */
    BELTGAUGE_AT_HEARTBEAT = 10, /* U16, rises ten times a second while frames arrive; wraps */
    BELTGAUGE_AT_STATUS = 11, /* U16, bit 0 running, bit 1 ready (belt learned), bit 2 belt motion measured, bit 3 by the encoder, bit 4 stopped by command, bit 5 PLC silent, bit 6 parcels wait to be acknowledged */
    BELTGAUGE_AT_FAULT = 12, /* U16, bit 0 frame source ended, bit 1 a table has been full since start (see counters), bit 2 a parcel was never acknowledged, bit 3 CAN bus off or down, bit 4 encoder silent, bit 5 no camera, bit 6 the disk fails, bit 7 encoder and belt disagree, bit 8 the belt does not run as configured, bit 9 the belt hides parcels, bit 10 frames are missing, bit 11 the archive fails, bit 12 the camera has moved, bit 13 the picture is unsharp, bit 14 the light has changed */
    BELTGAUGE_AT_BELT_SPEED = 13, /* U32, mm/s, scale 10: belt speed */
    BELTGAUGE_AT_FRAMES = 15, /* U32, frames processed; wraps */
    BELTGAUGE_AT_FRAMES_DROPPED = 17, /* U32, frames that came too late; wraps */
    BELTGAUGE_AT_PARCELS = 19, /* U32, sequence number of the latest parcel */
    BELTGAUGE_AT_PARCELS_UNMEASURED = 21, /* U32, of the parcels, those that could not be measured */
    BELTGAUGE_AT_PARCELS_LOST = 23, /* U32, parcels that vanished inside the view */
    BELTGAUGE_AT_SEGMENT_OVERFLOWS = 25, /* U32, frames with more runs or blobs than the tables hold */
    BELTGAUGE_AT_TRACK_OVERFLOWS = 27, /* U32, blobs that found no free track */
    BELTGAUGE_AT_EVENT_OVERFLOWS = 29, /* U32, records that found the queue to the PLC full */
    BELTGAUGE_AT_TIME = 31, /* U32, ms, scale 1: time of the newest frame since start; wraps */
    BELTGAUGE_AT_BELT_TRAVEL = 33, /* U32, mm, scale 10: belt travel since start; wraps after 429 km */
    BELTGAUGE_AT_REASON = 35, /* U16, what matters most */
    BELTGAUGE_AT_BOOTS = 36, /* U16, starts of the appliance, 0 when plc.state_file is not set; wraps */
    BELTGAUGE_AT_QUEUED = 37, /* U16, parcels that wait to be acknowledged */
    BELTGAUGE_AT_QUEUE_OVERFLOWS = 38, /* U32, parcels that left the queue without having been acknowledged; wraps */
    BELTGAUGE_AT_TICKET_DONE = 40, /* U16, ticket of the last command */
    BELTGAUGE_AT_RESULT = 41, /* U16, what became of it */
    BELTGAUGE_AT_SCALE_INTERVAL = 42, /* U16, mm, scale 10: dimensions are rounded to multiples of it */
    BELTGAUGE_AT_CAN_STATE = 43, /* U16, 0 not configured, 1 active, 2 error passive, 3 bus off, 4 down */
    BELTGAUGE_AT_CAN_TRANSMIT_ERRORS = 44, /* U16, error counter of the controller, when it last told */
    BELTGAUGE_AT_CAN_RECEIVE_ERRORS = 45, /* U16, error counter of the controller, when it last told */
    BELTGAUGE_AT_CAN_BUS_OFFS = 46, /* U32, how often the bus was lost; wraps */
    BELTGAUGE_AT_CAN_PARCELS_DROPPED = 48, /* U32, parcels that could not be sent in time; wraps */
    BELTGAUGE_AT_CAN_FRAMES_REFUSED = 50, /* U32, frames that the interface refused for ever; wraps */
    BELTGAUGE_AT_FRAMES_LOST = 52, /* U32, frames that the camera counted and that never came; wraps */
    BELTGAUGE_AT_FRAMES_TORN = 54, /* U32, frames that came with parts missing; wraps */
    BELTGAUGE_AT_CAMERA_LOSSES = 56, /* U16, how often the camera was lost; wraps */
    BELTGAUGE_AT_IMPORTS = 57, /* U16, configurations that came on a stick; wraps */
    BELTGAUGE_AT_IMPORT_RESULT = 58, /* U16, of the last: 0 there was none, 1 applied, 2 refused, 3 rolled back */
    BELTGAUGE_AT_BELT_SEEN = 70, /* I32, mm/s, scale 10: belt speed that the pictures show, negative against +X; 0: none */
    BELTGAUGE_AT_ENCODER_RATIO = 72, /* I16, scale 10000: the encoder's travel over the belt's, negative when it counts the other way; 0: not known, or it stands */
    BELTGAUGE_AT_MM_PER_COUNT = 73, /* I32, mm, scale 1000000: belt travel of a count, as configured or set by command 6; 0: no encoder */
    BELTGAUGE_AT_MM_PER_COUNT_SEEN = 75, /* I32, mm, scale 1000000: the same as the belt's texture shows it; 0: not known */
    BELTGAUGE_AT_CAMERA_WATCH = 77, /* U16, whether a camera that moves is seen: 0 what stands is being learned, 1 no: too little stands, 2 across travel alone, 3 along travel alone, 4 yes */
    BELTGAUGE_AT_CAMERA_MOVED = 78, /* U16, px, scale 100: how far the picture has moved since start */
    BELTGAUGE_AT_CAMERA_ERROR = 79, /* U16, mm, scale 100: the largest error that it causes, of a place or of a dimension */
    BELTGAUGE_AT_BLUR = 80, /* U16, px, scale 100: standard deviation of the picture's blur; 0: not known */
    BELTGAUGE_AT_LIGHT_REGION = 81, /* U16, the part of the picture whose light has changed most since start: 4 columns and 3 rows, from 1 at the top left, row by row; 0: not known */
    BELTGAUGE_AT_LIGHT_CHANGE = 82, /* I16, %, scale 1: by how much */
};

/* Where a PLC writes, and what. */
enum {
    BELTGAUGE_AT_PLC_HEARTBEAT = 60, /* U16, any value that keeps changing while the PLC is alive */
    BELTGAUGE_AT_ACKNOWLEDGE = 61, /* U16, low word of the sequence number up to which parcels were taken; writing it again does no harm */
    BELTGAUGE_AT_ENCODER_COUNT = 62, /* U32, belt position as the encoder counts it, as often as possible; wraps at encoder.bits */
    BELTGAUGE_AT_TICKET = 64, /* U16, the command is carried out when this is written with another value than the last one; 0: no command */
    BELTGAUGE_AT_COMMAND = 65, /* U16, code */
    BELTGAUGE_AT_ARGUMENT = 66, /* U32, of the command */
};

/* Bits of the status word. */
enum {
    BELTGAUGE_STATUS_BIT_RUNNING = 1,
    BELTGAUGE_STATUS_BIT_READY = 2,
    BELTGAUGE_STATUS_BIT_BELT_MEASURED = 4,
    BELTGAUGE_STATUS_BIT_BY_ENCODER = 8,
    BELTGAUGE_STATUS_BIT_STOPPED = 16,
    BELTGAUGE_STATUS_BIT_PLC_SILENT = 32,
    BELTGAUGE_STATUS_BIT_PARCELS_WAIT = 64,
};

/* Bits of the fault word. */
enum {
    BELTGAUGE_FAULT_SOURCE_ENDED = 1,
    BELTGAUGE_FAULT_TABLE_FULL = 2,
    BELTGAUGE_FAULT_PARCEL_NEVER_ACKNOWLEDGED = 4,
    BELTGAUGE_FAULT_CAN_OFF = 8,
    BELTGAUGE_FAULT_ENCODER_SILENT = 16,
    BELTGAUGE_FAULT_CAMERA_ABSENT = 32,
    BELTGAUGE_FAULT_DISK_FAILS = 64,
    BELTGAUGE_FAULT_ENCODER_DISAGREES = 128,
    BELTGAUGE_FAULT_BELT_NOT_AS_CONFIGURED = 256,
    BELTGAUGE_FAULT_BELT_HIDES_PARCELS = 512,
    BELTGAUGE_FAULT_FRAMES_MISSING = 1024,
    BELTGAUGE_FAULT_ARCHIVE_FAILS = 2048,
    BELTGAUGE_FAULT_CAMERA_MOVED = 4096,
    BELTGAUGE_FAULT_PICTURE_BLURRED = 8192,
    BELTGAUGE_FAULT_LIGHT_CHANGED = 16384,
};

/* Bits of a parcel's `valid`. */
enum {
    BELTGAUGE_VALID_MAY_BE_USED = 1,
    BELTGAUGE_VALID_IS_BOX = 2,
    BELTGAUGE_VALID_BY_ENCODER = 4,
    BELTGAUGE_VALID_MEASURED = 8,
};

/* Doubts about a parcel. */
enum {
    BELTGAUGE_FLAG_UNFINISHED = 1, /* still inside when the input ended */
    BELTGAUGE_FLAG_MERGED = 2, /* its image ran together with a neighbour's for some of the pass */
    BELTGAUGE_FLAG_CLIPPED = 4, /* it reached over the side of the zone; parts outside are not used */
    BELTGAUGE_FLAG_HEIGHT_UNCERTAIN = 8, /* standard deviation of the height above measure.sigma_max_mm */
    BELTGAUGE_FLAG_SPEED_ASSUMED = 16, /* belt speed assumed, not measured: trust no height */
    BELTGAUGE_FLAG_LOST = 32, /* it vanished inside the zone, or over a gap in the frames */
    BELTGAUGE_FLAG_SILHOUETTE_ONLY = 64, /* too few edges: a rough size, trust no dimension */
    BELTGAUGE_FLAG_TOO_TALL = 128, /* taller than view.height_max_mm: trust no dimension */
    BELTGAUGE_FLAG_FOOTPRINT_UNCERTAIN = 256, /* standard deviation of length or width above measure.sigma_max_mm */
    BELTGAUGE_FLAG_HEIGHT_DISPUTED = 512, /* texture on the top and its edges disagree about the height */
};

/* Why a parcel has no dimensions; 0: it has. */
enum {
    BELTGAUGE_NOT_MEASURED_TOO_BRIEF = 1, /* seen in too few frames or over too little travel */
    BELTGAUGE_NOT_MEASURED_NEVER_ALONE = 2, /* its image was never apart from another's */
    BELTGAUGE_NOT_MEASURED_LOST = 3, /* it vanished inside the zone before its edges could be measured */
    BELTGAUGE_NOT_MEASURED_BELT_MOTION_UNKNOWN = 4, /* the belt's motion was not known while it passed, as over a gap in the frames */
};

/* What matters most in the appliance's state. */
enum {
    BELTGAUGE_REASON_ALL_IS_WELL = 0, /* all is well */
    BELTGAUGE_REASON_SOURCE_ENDED = 1, /* the frame source has ended or failed */
    BELTGAUGE_REASON_NO_FRAMES = 2, /* no frames arrive */
    BELTGAUGE_REASON_CAN_BUS_OFF = 3, /* CAN: bus off */
    BELTGAUGE_REASON_CAN_DOWN = 4, /* CAN: interface down or not there */
    BELTGAUGE_REASON_CAN_ERROR_PASSIVE = 5, /* CAN: error passive, nobody acknowledges */
    BELTGAUGE_REASON_ENCODER_SILENT = 6, /* the encoder does not count */
    BELTGAUGE_REASON_PLC_SILENT = 7, /* the PLC is silent */
    BELTGAUGE_REASON_LEARNING = 8, /* the empty belt is being learned */
    BELTGAUGE_REASON_STOPPED = 9, /* stopped by command */
    BELTGAUGE_REASON_PARCEL_NEVER_ACKNOWLEDGED = 10, /* a parcel found the queue full and was never acknowledged, since start */
    BELTGAUGE_REASON_TABLE_FULL = 11, /* a table or queue has been full since start, see the counters */
    BELTGAUGE_REASON_CAMERA_ABSENT = 12, /* the camera is not there, or does not do what the configuration asks for: see the log */
    BELTGAUGE_REASON_IMPORT_REFUSED = 13, /* the last configuration that was imported was refused: see its report */
    BELTGAUGE_REASON_DISK_FAILS = 14, /* the disk fails: sequence numbers, acknowledgments and tickets would not survive a restart; see the log */
    BELTGAUGE_REASON_ENCODER_DISAGREES = 15, /* the encoder and the belt disagree: see encoder_ratio; correct encoder.mm_per_count, or give command 6 */
    BELTGAUGE_REASON_BELT_NOT_AS_CONFIGURED = 16, /* the belt does not run as configured: see belt_seen for its speed and direction */
    BELTGAUGE_REASON_BELT_AMBIGUOUS = 17, /* the belt's texture repeats itself, so that its motion is ambiguous: fit an encoder */
    BELTGAUGE_REASON_BELT_HIDES_PARCELS = 18, /* the belt's texture or the camera's noise is so strong that it hides parcels */
    BELTGAUGE_REASON_FRAMES_MISSING = 19, /* of the frames of the last 10 s more than 1 in 100 are missing: see frames_dropped, frames_lost, frames_torn */
    BELTGAUGE_REASON_ARCHIVE_FAILS = 20, /* the archive: its disk fails or does not answer, entries were lost, or damage was found, since start; see the page */
    BELTGAUGE_REASON_CAMERA_MOVED = 21, /* the camera has moved a little: see camera_moved, camera_error; fasten it */
    BELTGAUGE_REASON_CAMERA_MISPLACED = 22, /* the camera has moved so far that sizes and places are wrong: calibrate the belt again */
    BELTGAUGE_REASON_PICTURE_BLURRED = 23, /* the picture is less sharp than it should be: see blur; clean and focus the lens */
    BELTGAUGE_REASON_PICTURE_UNUSABLE = 24, /* the picture is so unsharp that heights are wrong: see blur; focus the lens */
    BELTGAUGE_REASON_LIGHT_CHANGED = 25, /* the light has changed, or the lens is dirty: see light_region, light_change */
};

/* What may be commanded. */
enum {
    BELTGAUGE_COMMAND_ACKNOWLEDGE = 1, /* acknowledge parcels up to sequence number `argument`, as register `acknowledge` does */
    BELTGAUGE_COMMAND_LEARN = 2, /* learn the empty belt anew: takes background.learn_frames, parcels in view are forgotten */
    BELTGAUGE_COMMAND_START = 3, /* start: report parcels */
    BELTGAUGE_COMMAND_STOP = 4, /* stop: report none until started */
    BELTGAUGE_COMMAND_ROUND = 5, /* round dimensions to multiples of `argument` tenths of a mm, 1 to 500 */
    BELTGAUGE_COMMAND_CORRECT_ENCODER = 6, /* correct the encoder's scale by the belt's texture: mm_per_count becomes mm_per_count_seen, for good; refused when they differ by more than 40 % */
};

/* What became of a command. */
enum {
    BELTGAUGE_RESULT_NONE = 0, /* no command yet */
    BELTGAUGE_RESULT_DONE = 1, /* done */
    BELTGAUGE_RESULT_UNKNOWN_COMMAND = 2, /* no such command */
    BELTGAUGE_RESULT_ARGUMENT_OUT_OF_RANGE = 3, /* argument out of range: nothing was changed */
    BELTGAUGE_RESULT_BUSY = 4, /* busy with earlier commands: try again with the next ticket */
    BELTGAUGE_RESULT_TICKET_USED = 5, /* the last command, another one, had this ticket: nothing was done, take the next ticket */
    BELTGAUGE_RESULT_NOT_KNOWN = 6, /* what it needs is not known: no encoder, or the belt has not travelled far enough */
};

/* What a parcel looks like. */
typedef enum {
    BELTGAUGE_SHAPE_BOX, /* a box */
    BELTGAUGE_SHAPE_IRREGULAR, /* anything else, in the smallest upright box that holds it */
} beltgauge_shape;

/* Two registers, the high word first. */
static inline uint32_t beltgauge_u32(const uint16_t *registers)
{
    return ((uint32_t)registers[0] << 16) | registers[1];
}

/* Two's complement, without what C leaves to the compiler. */
static inline int16_t beltgauge_i16(uint16_t stored)
{
    return (int16_t)((int32_t)stored - (stored > INT16_MAX ? 65536 : 0));
}

static inline int32_t beltgauge_i32(uint32_t stored)
{
    return (int32_t)((int64_t)stored - (stored > INT32_MAX ? INT64_C(4294967296) : 0));
}

typedef struct {
    uint32_t sequence; /* from 1; 0 = no parcel yet */
    uint16_t valid; /* bit 0 the dimensions may be used: sort by them only then; bit 1 its shape is a box; bit 2 the encoder told the belt's motion; bit 3 it was measured */
    uint16_t flags; /* doubts */
    float length_mm; /* longer side of the footprint, or as plc.order says */
    float width_mm; /* shorter side of the footprint, or as plc.order says */
    float height_mm; /* height over the belt, or as plc.order says */
    float yaw_deg; /* length axis against travel, counter-clockwise, (-90, 90] */
    float x_mm; /* footprint centre along travel, at time */
    float y_mm; /* footprint centre across, left positive */
    float sigma_length_mm; /* standard deviation */
    float sigma_width_mm; /* standard deviation */
    float sigma_height_mm; /* standard deviation */
    uint16_t quality_length_percent; /* 100 - 20 sigma/mm, at least 0 */
    uint16_t quality_width_percent; /* 100 - 20 sigma/mm, at least 0 */
    uint16_t quality_height_percent; /* 100 - 20 sigma/mm, at least 0 */
    uint32_t belt_speed_10_per_mm_per_s; /* mean over the pass */
    uint32_t frame; /* frame at which x and y hold; wraps */
    uint32_t time_ms; /* time of that frame since start; wraps */
    uint32_t belt_travel_10_per_mm; /* belt travel since start at that frame; wraps after 429 km */
    uint16_t not_measured; /* why it has no dimensions; 0: it has */
    uint32_t sequence_end; /* equals sequence unless the block changed between two requests */
} beltgauge_parcel;

/* Decodes the registers of one block. */
static inline beltgauge_parcel beltgauge_decode_parcel(const uint16_t *block)
{
    beltgauge_parcel parcel;
    parcel.sequence = beltgauge_u32(&block[0]);
    parcel.valid = block[2];
    parcel.flags = block[3];
    parcel.length_mm = (float)block[4] / 10.0f;
    parcel.width_mm = (float)block[5] / 10.0f;
    parcel.height_mm = (float)block[6] / 10.0f;
    parcel.yaw_deg = (float)beltgauge_i16(block[7]) / 100.0f;
    parcel.x_mm = (float)beltgauge_i32(beltgauge_u32(&block[8])) / 10.0f;
    parcel.y_mm = (float)beltgauge_i32(beltgauge_u32(&block[10])) / 10.0f;
    parcel.sigma_length_mm = (float)block[12] / 100.0f;
    parcel.sigma_width_mm = (float)block[13] / 100.0f;
    parcel.sigma_height_mm = (float)block[14] / 100.0f;
    parcel.quality_length_percent = block[15];
    parcel.quality_width_percent = block[16];
    parcel.quality_height_percent = block[17];
    parcel.belt_speed_10_per_mm_per_s = beltgauge_u32(&block[18]);
    parcel.frame = beltgauge_u32(&block[20]);
    parcel.time_ms = beltgauge_u32(&block[22]);
    parcel.belt_travel_10_per_mm = beltgauge_u32(&block[24]);
    parcel.not_measured = block[26];
    parcel.sequence_end = beltgauge_u32(&block[30]);
    return parcel;
}

typedef struct {
    uint16_t identity; /* constant 0x4247, "BG" */
    uint16_t map_version; /* major in the high byte, minor in the low */
    uint32_t test_u32; /* constant 0x12345678: checks the word order */
    int16_t test_i16; /* constant -12345: checks the sign */
    uint16_t heartbeat; /* rises ten times a second while frames arrive; wraps */
    uint16_t status; /* bit 0 running, bit 1 ready (belt learned), bit 2 belt motion measured, bit 3 by the encoder, bit 4 stopped by command, bit 5 PLC silent, bit 6 parcels wait to be acknowledged */
    uint16_t fault; /* bit 0 frame source ended, bit 1 a table has been full since start (see counters), bit 2 a parcel was never acknowledged, bit 3 CAN bus off or down, bit 4 encoder silent, bit 5 no camera, bit 6 the disk fails, bit 7 encoder and belt disagree, bit 8 the belt does not run as configured, bit 9 the belt hides parcels, bit 10 frames are missing, bit 11 the archive fails, bit 12 the camera has moved, bit 13 the picture is unsharp, bit 14 the light has changed */
    uint32_t belt_speed_10_per_mm_per_s; /* belt speed */
    uint32_t frames; /* frames processed; wraps */
    uint32_t frames_dropped; /* frames that came too late; wraps */
    uint32_t parcels; /* sequence number of the latest parcel */
    uint32_t parcels_unmeasured; /* of the parcels, those that could not be measured */
    uint32_t parcels_lost; /* parcels that vanished inside the view */
    uint32_t segment_overflows; /* frames with more runs or blobs than the tables hold */
    uint32_t track_overflows; /* blobs that found no free track */
    uint32_t event_overflows; /* records that found the queue to the PLC full */
    uint32_t time_ms; /* time of the newest frame since start; wraps */
    uint32_t belt_travel_10_per_mm; /* belt travel since start; wraps after 429 km */
    uint16_t reason; /* what matters most */
    uint16_t boots; /* starts of the appliance, 0 when plc.state_file is not set; wraps */
    uint16_t queued; /* parcels that wait to be acknowledged */
    uint32_t queue_overflows; /* parcels that left the queue without having been acknowledged; wraps */
    uint16_t ticket_done; /* ticket of the last command */
    uint16_t result; /* what became of it */
    float scale_interval_mm; /* dimensions are rounded to multiples of it */
    uint16_t can_state; /* 0 not configured, 1 active, 2 error passive, 3 bus off, 4 down */
    uint16_t can_transmit_errors; /* error counter of the controller, when it last told */
    uint16_t can_receive_errors; /* error counter of the controller, when it last told */
    uint32_t can_bus_offs; /* how often the bus was lost; wraps */
    uint32_t can_parcels_dropped; /* parcels that could not be sent in time; wraps */
    uint32_t can_frames_refused; /* frames that the interface refused for ever; wraps */
    uint32_t frames_lost; /* frames that the camera counted and that never came; wraps */
    uint32_t frames_torn; /* frames that came with parts missing; wraps */
    uint16_t camera_losses; /* how often the camera was lost; wraps */
    uint16_t imports; /* configurations that came on a stick; wraps */
    uint16_t import_result; /* of the last: 0 there was none, 1 applied, 2 refused, 3 rolled back */
    float belt_seen_mm_per_s; /* belt speed that the pictures show, negative against +X; 0: none */
    float encoder_ratio; /* the encoder's travel over the belt's, negative when it counts the other way; 0: not known, or it stands */
    float mm_per_count; /* belt travel of a count, as configured or set by command 6; 0: no encoder */
    float mm_per_count_seen; /* the same as the belt's texture shows it; 0: not known */
    uint16_t camera_watch; /* whether a camera that moves is seen: 0 what stands is being learned, 1 no: too little stands, 2 across travel alone, 3 along travel alone, 4 yes */
    float camera_moved_px; /* how far the picture has moved since start */
    float camera_error_mm; /* the largest error that it causes, of a place or of a dimension */
    float blur_px; /* standard deviation of the picture's blur; 0: not known */
    uint16_t light_region; /* the part of the picture whose light has changed most since start: 4 columns and 3 rows, from 1 at the top left, row by row; 0: not known */
    int16_t light_change_percent; /* by how much */
} beltgauge_status;

/* Decodes the registers of one block. */
static inline beltgauge_status beltgauge_decode_status(const uint16_t *block)
{
    beltgauge_status status;
    status.identity = block[0];
    status.map_version = block[1];
    status.test_u32 = beltgauge_u32(&block[2]);
    status.test_i16 = beltgauge_i16(block[4]);
    status.heartbeat = block[10];
    status.status = block[11];
    status.fault = block[12];
    status.belt_speed_10_per_mm_per_s = beltgauge_u32(&block[13]);
    status.frames = beltgauge_u32(&block[15]);
    status.frames_dropped = beltgauge_u32(&block[17]);
    status.parcels = beltgauge_u32(&block[19]);
    status.parcels_unmeasured = beltgauge_u32(&block[21]);
    status.parcels_lost = beltgauge_u32(&block[23]);
    status.segment_overflows = beltgauge_u32(&block[25]);
    status.track_overflows = beltgauge_u32(&block[27]);
    status.event_overflows = beltgauge_u32(&block[29]);
    status.time_ms = beltgauge_u32(&block[31]);
    status.belt_travel_10_per_mm = beltgauge_u32(&block[33]);
    status.reason = block[35];
    status.boots = block[36];
    status.queued = block[37];
    status.queue_overflows = beltgauge_u32(&block[38]);
    status.ticket_done = block[40];
    status.result = block[41];
    status.scale_interval_mm = (float)block[42] / 10.0f;
    status.can_state = block[43];
    status.can_transmit_errors = block[44];
    status.can_receive_errors = block[45];
    status.can_bus_offs = beltgauge_u32(&block[46]);
    status.can_parcels_dropped = beltgauge_u32(&block[48]);
    status.can_frames_refused = beltgauge_u32(&block[50]);
    status.frames_lost = beltgauge_u32(&block[52]);
    status.frames_torn = beltgauge_u32(&block[54]);
    status.camera_losses = block[56];
    status.imports = block[57];
    status.import_result = block[58];
    status.belt_seen_mm_per_s = (float)beltgauge_i32(beltgauge_u32(&block[70])) / 10.0f;
    status.encoder_ratio = (float)beltgauge_i16(block[72]) / 10000.0f;
    status.mm_per_count = (float)beltgauge_i32(beltgauge_u32(&block[73])) / 1000000.0f;
    status.mm_per_count_seen = (float)beltgauge_i32(beltgauge_u32(&block[75])) / 1000000.0f;
    status.camera_watch = block[77];
    status.camera_moved_px = (float)block[78] / 100.0f;
    status.camera_error_mm = (float)block[79] / 100.0f;
    status.blur_px = (float)block[80] / 100.0f;
    status.light_region = block[81];
    status.light_change_percent = beltgauge_i16(block[82]);
    return status;
}

/* Whether the registers from address 0 on are those of this header, in this word order. If not, decode nothing:
   another device, another major version, or modbus.word_order = "low_first". */
static inline bool beltgauge_is_known(const uint16_t *status_block)
{
    return status_block[0] == 0x4247u && status_block[1] >> 8 == BELTGAUGE_MAP_MAJOR
        && beltgauge_u32(&status_block[2]) == UINT32_C(0x12345678)
        && status_block[4] == 0xCFC7u;
}

/* There is a parcel, and it did not change between two requests. */
static inline bool beltgauge_is_whole(const beltgauge_parcel *parcel)
{
    return parcel->sequence != 0 && parcel->sequence == parcel->sequence_end;
}

/* Sort by the dimensions only when this is true. */
static inline bool beltgauge_may_be_used(const beltgauge_parcel *parcel)
{
    return beltgauge_is_whole(parcel) && (parcel->valid & BELTGAUGE_VALID_MAY_BE_USED) != 0;
}

static inline beltgauge_shape beltgauge_shape_of(const beltgauge_parcel *parcel)
{
    return (parcel->valid & BELTGAUGE_VALID_IS_BOX) != 0 ? BELTGAUGE_SHAPE_BOX : BELTGAUGE_SHAPE_IRREGULAR;
}

/* Address of a parcel among the last 32. `sequence` is at least 1. */
static inline uint16_t beltgauge_ring_address(uint32_t sequence)
{
    return (uint16_t)(BELTGAUGE_AT_RING + (sequence - 1u) % BELTGAUGE_RING_PARCELS * BELTGAUGE_PARCEL_REGISTERS);
}

/* Where the parcel's centre is along travel, by the belt travel that the status block shows now. */
static inline float beltgauge_x_now_mm(const beltgauge_parcel *parcel, const beltgauge_status *now)
{
    uint32_t travelled = now->belt_travel_10_per_mm - parcel->belt_travel_10_per_mm; /* survives the wrap */
    return parcel->x_mm + (float)beltgauge_i32(travelled) / 10.0f;
}

/* The ticket of the next command, after `ticket_done` of the status block: never 0. */
static inline uint16_t beltgauge_next_ticket(uint16_t ticket_done)
{
    return (uint16_t)(ticket_done % 65535u + 1u);
}

#endif
