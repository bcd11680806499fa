/* A GenTL producer with one camera, which knows its own sensor: for the gentl driver's tests.
 *
 * The sensor is 128 x 96, 12 bit, a mosaic whose first two pixels are R and G; the pixel at (x, y) of
 * the sensor holds (37 x + 101 y + 5) mod 4096, or else it sees a film, one picture a frame. As many real cameras do, it names the mosaic by the
 * region's first pixel: an odd offset turns BayerRG12p into BayerGR12p. Its frames can be triggered,
 * its clock latched, and it can be told to skip frames, to break them, and to vanish.
 *
 * Compiled by the tests; -DXML="path" names the description that the camera carries, -DFILM="path"
 * the film, if there is one: pictures of the whole sensor, 16 bit, one after the other.
 */
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum {
    OK = 0, NOT_IMPLEMENTED = -1003, IN_USE = -1004, BAD_HANDLE = -1006, NO_DATA = -1008,
    BAD_PARAMETER = -1009, IO_ERROR = -1010, TIMEOUT = -1011, ABORTED = -1012,
    NOT_AVAILABLE = -1014, BAD_ADDRESS = -1015, TOO_SMALL = -1016,
};
enum { STRING = 1, INT32 = 5, UINT32 = 6, UINT64 = 8, PTR = 10, BOOL8 = 11, SIZET = 12 };
enum { SENSOR_W = 128, SENSOR_H = 96, XML_AT = 0x10000000 };
enum { /* registers, 8 bytes each, by number */
    WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT, PAYLOAD, ACQUIRE, TRIGGER_MODE, TRIGGER_SOURCE,
    TRIGGER, EXPOSURE_US, LATCH, LATCHED_NS, SKIP, BREAK, VANISH, PADDING_X, RATE_MHZ, REGISTERS
};
enum { PLAIN, STREAM, GIGE, EIGHT, PACKINGS };

typedef int32_t error;
typedef struct buffer {
    struct buffer *next;
    uint8_t *data;
    size_t size, filled;
    void *user;
    bool ours, queued, whole;
    uint64_t id, stamp_ns;
    int64_t made[REGISTERS]; /* the settings that it was exposed with */
} buffer;

/* PFNC's numbers, by packing and by the first two pixels: RG, GR, GB, BG */
static const uint32_t CODES[PACKINGS][4] = {
    {0x01100011, 0x01100010, 0x01100012, 0x01100013},
    {0x010C0059, 0x010C0057, 0x010C0055, 0x010C0053},
    {0x010C002B, 0x010C002A, 0x010C002C, 0x010C002D},
    {0x01080009, 0x01080008, 0x0108000A, 0x0108000B},
};

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static char tl, interface, local, remote, stream, event; /* handles are their addresses */
static bool is_open;
static char *xml;
static size_t xml_size;
static char *film;
static size_t film_size;
static int64_t reg[REGISTERS];
static int packing;
static buffer *announced, *queue, *current;
static bool acquiring, killed;
static uint64_t frame_id, due_ns;
static int pending;

static uint64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + t.tv_nsec;
}

static uint64_t period_ns(void) { return 1000000000000u / reg[RATE_MHZ]; }

static error give(const void *from, size_t size, int32_t type, int32_t *told, void *to, size_t *room)
{
    if (told) *told = type;
    if (!room) return BAD_PARAMETER;
    if (to && *room < size) return TOO_SMALL;
    if (to) memcpy(to, from, size);
    *room = size;
    return OK;
}

static error text(const char *s, int32_t *type, void *to, size_t *room)
{
    return give(s, strlen(s) + 1, STRING, type, to, room);
}

/* ---------------------------------------------------------------- the camera */

static int phase(void)
{
    static const int by_parity[2][2] = {{0, 1}, {2, 3}}; /* [y odd][x odd] */
    return by_parity[reg[OFFSET_Y] & 1][reg[OFFSET_X] & 1];
}

static size_t row_bits(const int64_t *r, int how)
{
    return (size_t)r[WIDTH] * (how == PLAIN ? 16 : how == EIGHT ? 8 : 12);
}

static size_t payload(void)
{
    size_t bits = row_bits(reg, packing);
    if (!reg[PADDING_X]) return (bits * reg[HEIGHT] + 7) / 8;
    return ((bits + 7) / 8 + reg[PADDING_X]) * reg[HEIGHT];
}

static unsigned seen(int64_t x, int64_t y)
{
    size_t picture = 2 * SENSOR_W * SENSOR_H, pictures = film_size / picture;
    if (!pictures) return (37 * x + 101 * y + 5) % 4096;
    return ((uint16_t *)(film + frame_id % pictures * picture))[y * SENSOR_W + x];
}

static void expose(buffer *b)
{
    size_t bit = 0;
    memset(b->data, 0, b->size);
    for (int64_t y = 0; y < reg[HEIGHT]; y++) {
        for (int64_t x = 0; x < reg[WIDTH]; x++) {
            unsigned v = seen(x + reg[OFFSET_X], y + reg[OFFSET_Y]);
            size_t at = bit / 8;
            if (packing == PLAIN) {
                b->data[at] = v, b->data[at + 1] = v >> 8;
            } else if (packing == EIGHT) {
                b->data[at] = v >> 4;
            } else if (bit % 8 == 0) { /* the first of a pair */
                b->data[at] = packing == STREAM ? v : v >> 4;
                b->data[at + 1] |= packing == STREAM ? v >> 8 : v & 15;
            } else {
                b->data[at] |= (v & 15) << 4;
                b->data[at + 1] = v >> 4;
            }
            bit += packing == PLAIN ? 16 : packing == EIGHT ? 8 : 12;
        }
        if (reg[PADDING_X]) bit = (bit + 7) / 8 * 8 + 8 * reg[PADDING_X];
    }
    b->whole = true;
    b->filled = payload();
    if (reg[BREAK] > 0) reg[BREAK]--, b->whole = false, b->filled /= 2;
    while (reg[SKIP] > 0) reg[SKIP]--, frame_id++;
    b->id = frame_id++;
    b->stamp_ns = due_ns - 1000u * reg[EXPOSURE_US];
    memcpy(b->made, reg, sizeof reg);
    b->made[PIXEL_FORMAT] = CODES[packing][phase()];
}

static error write_register(int k, int64_t value)
{
    switch (k) {
    case PIXEL_FORMAT:
        for (int p = 0; p < PACKINGS; p++)
            for (int c = 0; c < 4; c++)
                if (CODES[p][c] == (uint32_t)value) {
                    packing = p;
                    return OK;
                }
        return BAD_PARAMETER;
    case ACQUIRE:
        acquiring = value;
        due_ns = now_ns() + period_ns();
        pending = 0;
        break;
    case TRIGGER:
        if (reg[TRIGGER_MODE] && !pending) pending = 1, due_ns = now_ns() + 1000u * reg[EXPOSURE_US];
        break;
    case LATCH: reg[LATCHED_NS] = now_ns(); break;
    default: reg[k] = value;
    }
    pthread_cond_broadcast(&changed);
    return OK;
}

/* ---------------------------------------------------------------- library and ports */

static char *contents(const char *path, size_t *size)
{
    FILE *f = fopen(path, "rb");
    *size = 0;
    if (!f) return NULL;
    fseek(f, 0, SEEK_END);
    size_t length = ftell(f);
    rewind(f);
    char *data = malloc(length + 1);
    *size = fread(data, 1, length, f);
    fclose(f);
    return data;
}

error GCInitLib(void)
{
    xml = contents(XML, &xml_size);
    film = contents(FILM, &film_size);
    memset(reg, 0, sizeof reg);
    reg[WIDTH] = SENSOR_W, reg[HEIGHT] = SENSOR_H, reg[EXPOSURE_US] = 2000, reg[RATE_MHZ] = 100000;
    packing = PLAIN;
    return xml ? OK : IO_ERROR;
}

error GCCloseLib(void)
{
    free(xml), free(film);
    xml = film = NULL;
    is_open = false;
    return OK;
}

error GCGetLastError(error *code, char *words, size_t *room)
{
    if (code) *code = reg[VANISH] ? IO_ERROR : OK;
    return text(reg[VANISH] ? "the toy was unplugged" : "no", NULL, words, room);
}

static error about(int32_t cmd, int32_t *type, void *to, size_t *room)
{
    static const char *words[] = {"toy", "Umbra's tests", "Toy", "1.0", "Custom", "toy.cti", "toy.cti", "Toy"};
    uint32_t number = cmd == 8 ? 0 : cmd == 9 ? 1 : 5;
    if (cmd >= 8) return give(&number, 4, cmd == 8 ? INT32 : UINT32, type, to, room);
    return text(words[cmd], type, to, room);
}

error GCGetInfo(int32_t cmd, int32_t *t, void *to, size_t *n) { return about(cmd, t, to, n); }
error TLGetInfo(void *h, int32_t cmd, int32_t *t, void *to, size_t *n) { return about(cmd, t, to, n); }

error GCGetPortInfo(void *h, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    const char *module = h == &tl ? "TLSystem" : h == &interface ? "TLInterface"
        : h == &local ? "TLDevice" : h == &stream ? "TLDataStream" : "Device";
    bool yes = cmd == 5 || cmd == 7 || cmd == 8;
    if (cmd >= 5 && cmd <= 10) return give(&yes, 1, BOOL8, type, to, room);
    return text(cmd == 12 ? "Device" : cmd == 4 ? module : "Toy", type, to, room);
}

error GCGetNumPortURLs(void *h, uint32_t *n) { *n = 1; return OK; }

error GCGetPortURLInfo(void *h, uint32_t k, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    char url[80];
    snprintf(url, sizeof url, "Local:toy.xml;%x;%zx", XML_AT, xml_size);
    return cmd ? NOT_AVAILABLE : text(url, type, to, room);
}

error GCGetPortURL(void *h, char *to, size_t *room) { return GCGetPortURLInfo(h, 0, 0, NULL, to, room); }

error GCReadPort(void *h, uint64_t at, void *to, size_t *size)
{
    if (at >= XML_AT) {
        if (at - XML_AT + *size > xml_size) return BAD_ADDRESS;
        memcpy(to, xml + (at - XML_AT), *size);
        return OK;
    }
    if (h != &remote || at % 8 || at / 8 >= REGISTERS || *size != 8) return BAD_ADDRESS;
    pthread_mutex_lock(&lock);
    int64_t value = reg[at / 8];
    if (at / 8 == PIXEL_FORMAT) value = CODES[packing][phase()];
    if (at / 8 == PAYLOAD) value = payload();
    bool gone = reg[VANISH];
    pthread_mutex_unlock(&lock);
    memcpy(to, &value, 8);
    return gone ? IO_ERROR : OK;
}

error GCWritePort(void *h, uint64_t at, const void *from, size_t *size)
{
    int64_t value;
    if (h != &remote || at % 8 || at / 8 >= REGISTERS || *size != 8) return BAD_ADDRESS;
    memcpy(&value, from, 8);
    pthread_mutex_lock(&lock);
    error e = reg[VANISH] ? IO_ERROR : write_register(at / 8, value);
    pthread_mutex_unlock(&lock);
    return e;
}

error GCReadPortStacked(void *h, void *entries, size_t *n) { return NOT_IMPLEMENTED; }
error GCWritePortStacked(void *h, void *entries, size_t *n) { return NOT_IMPLEMENTED; }

/* ---------------------------------------------------------------- system, interface, device */

static error only(uint32_t k, char *to, size_t *room)
{
    return k ? BAD_PARAMETER : text("toy", NULL, to, room);
}

error TLOpen(void **h) { *h = &tl; return OK; }
error TLClose(void *h) { return OK; }
error TLUpdateInterfaceList(void *h, uint8_t *new, uint64_t ms) { if (new) *new = 1; return OK; }
error TLGetNumInterfaces(void *h, uint32_t *n) { *n = 1; return OK; }
error TLGetInterfaceID(void *h, uint32_t k, char *to, size_t *room) { return only(k, to, room); }
error TLGetInterfaceInfo(void *h, const char *id, int32_t cmd, int32_t *t, void *to, size_t *n)
{
    return text(cmd == 2 ? "Custom" : "toy", t, to, n);
}
error TLOpenInterface(void *h, const char *id, void **out) { *out = &interface; return OK; }
error IFClose(void *h) { return OK; }
error IFGetInfo(void *h, int32_t cmd, int32_t *t, void *to, size_t *n)
{
    return text(cmd == 2 ? "Custom" : "toy", t, to, n);
}
error IFGetParentTL(void *h, void **out) { *out = &tl; return OK; }
error IFUpdateDeviceList(void *h, uint8_t *new, uint64_t ms) { if (new) *new = 1; return OK; }
error IFGetNumDevices(void *h, uint32_t *n) { *n = 1; return OK; }
error IFGetDeviceID(void *h, uint32_t k, char *to, size_t *room) { return only(k, to, room); }

error DevGetInfo(void *h, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    static const char *words[] = {"toy", "Umbra", "Toy 12", "Custom", "Toy 12", "", "", "T12", "1"};
    int32_t status = is_open ? 4 : 1;
    uint64_t frequency = 1000000000;
    if (cmd == 5) return give(&status, 4, INT32, type, to, room);
    if (cmd == 9) return give(&frequency, 8, UINT64, type, to, room);
    return cmd > 8 ? NOT_AVAILABLE : text(words[cmd], type, to, room);
}
error IFGetDeviceInfo(void *h, const char *id, int32_t cmd, int32_t *t, void *to, size_t *n)
{
    return DevGetInfo(h, cmd, t, to, n);
}
error IFOpenDevice(void *h, const char *id, int32_t flags, void **out)
{
    if (is_open) return IN_USE;
    is_open = true;
    *out = &local;
    return OK;
}
error DevClose(void *h) { is_open = false; return OK; }
error DevGetPort(void *h, void **out) { *out = &remote; return OK; }
error DevGetParentIF(void *h, void **out) { *out = &interface; return OK; }
error DevGetNumDataStreams(void *h, uint32_t *n) { *n = 1; return OK; }
error DevGetDataStreamID(void *h, uint32_t k, char *to, size_t *room) { return only(k, to, room); }
error DevOpenDataStream(void *h, const char *id, void **out) { *out = &stream; return OK; }

/* ---------------------------------------------------------------- buffers */

error DSClose(void *h) { return OK; }
error DSGetParentDev(void *h, void **out) { *out = &local; return OK; }

error DSGetInfo(void *h, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    uint64_t counts = 0;
    size_t size = payload(), few = 1;
    bool yes = cmd == 8 ? acquiring : true;
    switch (cmd) {
    case 1: case 2: case 3: case 4: case 5: case 6: return give(&counts, 8, UINT64, type, to, room);
    case 7: return give(&size, sizeof size, SIZET, type, to, room);
    case 8: case 9: return give(&yes, 1, BOOL8, type, to, room);
    case 12: case 13: return give(&few, sizeof few, SIZET, type, to, room);
    case 0: case 10: return text(cmd ? "Custom" : "toy", type, to, room);
    default: return NOT_AVAILABLE;
    }
}

error DSAnnounceBuffer(void *h, void *data, size_t size, void *user, void **out)
{
    buffer *b = calloc(1, sizeof *b);
    b->ours = !data;
    b->data = data ? data : malloc(size);
    b->size = size;
    b->user = user;
    *out = b;
    return OK;
}
error DSAllocAndAnnounceBuffer(void *h, size_t size, void *user, void **out)
{
    return DSAnnounceBuffer(h, NULL, size, user, out);
}

error DSRevokeBuffer(void *h, void *which, void **data, void **user)
{
    buffer *b = which;
    if (data) *data = b->ours ? NULL : b->data;
    if (user) *user = b->user;
    if (b->ours) free(b->data);
    free(b);
    return OK;
}

error DSQueueBuffer(void *h, void *which)
{
    buffer *b = which, **last = &queue;
    pthread_mutex_lock(&lock);
    while (*last) last = &(*last)->next;
    *last = b;
    b->next = NULL;
    b->queued = true;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    return OK;
}

error DSFlushQueue(void *h, int32_t how)
{
    pthread_mutex_lock(&lock);
    if (how == 4 || how == 1) queue = how == 4 ? NULL : queue;
    pthread_mutex_unlock(&lock);
    return OK;
}

error DSGetBufferID(void *h, uint32_t k, void **out) { return NOT_IMPLEMENTED; }
error DSStartAcquisition(void *h, int32_t flags, uint64_t n) { killed = false; frame_id = 0; return OK; }
error DSStopAcquisition(void *h, int32_t flags) { return OK; }

error DSGetBufferInfo(void *h, void *which, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    buffer *b = which;
    size_t size = b->size, zero = 0;
    bool flag;
    uint64_t number;
    size_t length;
    switch (cmd) {
    case 0: return give(&b->data, sizeof b->data, PTR, type, to, room);
    case 1: return give(&size, sizeof size, SIZET, type, to, room);
    case 2: return give(&b->user, sizeof b->user, PTR, type, to, room);
    case 3: case 28: return give(&b->stamp_ns, 8, UINT64, type, to, room);
    case 4: case 6: case 17: flag = cmd != 6; return give(&flag, 1, BOOL8, type, to, room);
    case 5: return give(&b->queued, 1, BOOL8, type, to, room);
    case 7: flag = !b->whole; return give(&flag, 1, BOOL8, type, to, room);
    case 29: case 30: case 31: flag = false; return give(&flag, 1, BOOL8, type, to, room);
    case 8: return text("Custom", type, to, room);
    case 9: case 27: return give(&b->filled, sizeof b->filled, SIZET, type, to, room);
    case 10: length = b->made[WIDTH]; return give(&length, sizeof length, SIZET, type, to, room);
    case 11: case 22: length = b->made[HEIGHT]; return give(&length, sizeof length, SIZET, type, to, room);
    case 12: length = b->made[OFFSET_X]; return give(&length, sizeof length, SIZET, type, to, room);
    case 13: length = b->made[OFFSET_Y]; return give(&length, sizeof length, SIZET, type, to, room);
    case 14: length = b->made[PADDING_X]; return give(&length, sizeof length, SIZET, type, to, room);
    case 15: case 18: case 23: return give(&zero, sizeof zero, SIZET, type, to, room);
    case 16: return give(&b->id, 8, UINT64, type, to, room);
    case 19: length = 1; return give(&length, sizeof length, SIZET, type, to, room);
    case 20: number = b->made[PIXEL_FORMAT]; return give(&number, 8, UINT64, type, to, room);
    case 21: number = 4; return give(&number, 8, UINT64, type, to, room);
    case 26: { int32_t little = 1; return give(&little, 4, INT32, type, to, room); }
    default: return NOT_AVAILABLE;
    }
}

error DSGetBufferChunkData(void *h, void *b, void *chunks, size_t *n) { *n = 0; return NO_DATA; }
error DSGetNumBufferParts(void *h, void *b, uint32_t *n) { *n = 0; return OK; }
error DSGetBufferPartInfo(void *h, void *b, uint32_t k, int32_t c, int32_t *t, void *to, size_t *n)
{
    return NOT_AVAILABLE;
}

/* ---------------------------------------------------------------- events */

error GCRegisterEvent(void *h, int32_t type, void **out)
{
    if (type != 1 || h != &stream) return NOT_IMPLEMENTED;
    *out = &event;
    return OK;
}
error GCUnregisterEvent(void *h, int32_t type) { return OK; }

error EventGetInfo(void *h, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    int32_t kind = 1;
    uint64_t none = 0;
    size_t size = 2 * sizeof(void *);
    if (cmd == 0) return give(&kind, 4, INT32, type, to, room);
    if (cmd < 3) return give(&none, 8, UINT64, type, to, room);
    return give(&size, sizeof size, SIZET, type, to, room);
}

error EventGetData(void *h, void *to, size_t *room, uint64_t timeout_ms)
{
    uint64_t give_up = timeout_ms > 1u << 30 ? UINT64_MAX : now_ns() + timeout_ms * 1000000u;
    error result = OK;
    pthread_mutex_lock(&lock);
    for (;;) {
        uint64_t now = now_ns();
        bool exposes = acquiring && (!reg[TRIGGER_MODE] || pending);
        if (killed) { killed = false; result = ABORTED; break; }
        if (reg[VANISH]) { result = IO_ERROR; break; }
        if (exposes && queue && now >= due_ns) {
            buffer *b = queue;
            void *told[2] = {b, b->user};
            queue = b->next;
            b->queued = false;
            pending = 0;
            expose(b);
            due_ns += period_ns();
            memcpy(to, told, sizeof told);
            *room = sizeof told;
            break;
        }
        if (now >= give_up) { result = TIMEOUT; break; }
        uint64_t until = exposes && queue && due_ns < give_up ? due_ns : give_up;
        uint64_t wait = until - now < 10000000 ? until - now : 10000000;
        struct timespec t;
        clock_gettime(CLOCK_REALTIME, &t);
        t.tv_nsec += wait;
        if (t.tv_nsec >= 1000000000) t.tv_sec++, t.tv_nsec -= 1000000000;
        pthread_cond_timedwait(&changed, &lock, &t);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

error EventGetDataInfo(void *h, const void *in, size_t n, int32_t cmd, int32_t *type, void *to, size_t *room)
{
    return cmd == 1 ? give((char *)in, sizeof(void *), PTR, type, to, room) : NOT_AVAILABLE;
}
error EventFlush(void *h) { return OK; }
error EventKill(void *h)
{
    pthread_mutex_lock(&lock);
    killed = true;
    pthread_cond_broadcast(&changed);
    pthread_mutex_unlock(&lock);
    return OK;
}
