/* A Modbus server of another house: libmodbus, with registers of every type and order of bytes that test_modbus.py reads.
 *
 *   modbus_server tcp PORT              on 127.0.0.1
 *   modbus_server rtu DEVICE BAUDRATE   8N1
 *
 * Says "serving" once it does. On SIGTERM it says, as a line of JSON, how often it was asked for each function code
 * and how many of its registers are not what it has put there, and ends. It would let itself be written to.
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define DEVICE 1
#define REGISTERS 64
#define CODES 128
#define LOOK_UP 100000 /* us */

static volatile sig_atomic_t stopped;
static modbus_mapping_t *registers;
static uint16_t holding[REGISTERS], input[REGISTERS]; /* what we have put there */
static unsigned long asked[CODES];
static unsigned changed;

static void stop(int number)
{
	(void)number;
	stopped = 1;
}

/* Not by the library: its modbus_set_float_abcd() of 3.1.6 makes what everybody else calls BADC, and it has no others. */
static void put(uint16_t *at, uint64_t number, int words, const char *order)
{
	int backwards = order[0] == 'C' || order[0] == 'D';
	int swapped = order[0] == 'B' || order[0] == 'D';

	for (int word = 0; word < words; word++) {
		uint16_t found = (uint16_t)(number >> (16 * (words - 1 - word)));
		if (swapped)
			found = (uint16_t)(found << 8 | found >> 8);
		at[backwards ? words - 1 - word : word] = found;
	}
}

static void put_float(uint16_t *at, float number, const char *order)
{
	uint32_t bits;

	memcpy(&bits, &number, sizeof(bits));
	put(at, bits, 2, order);
}

static void put_double(uint16_t *at, double number, const char *order)
{
	uint64_t bits;

	memcpy(&bits, &number, sizeof(bits));
	put(at, bits, 4, order);
}

/* The machine has moved on by one request. */
static void move(unsigned count)
{
	float voltage = 24.0f + 0.015625f * (float)(count % 64);

	put_float(holding + 0, voltage, "ABCD");
	put_float(holding + 2, voltage, "CDAB");
	put_float(holding + 4, voltage, "BADC");
	put_float(holding + 6, voltage, "DCBA");
	holding[8] = (uint16_t)count;
	put(holding + 10, (uint32_t)-1234567, 2, "ABCD");
	put(holding + 12, (uint32_t)-1234567, 2, "CDAB");
	put(holding + 14, 4123456789u, 2, "ABCD");
	put(holding + 16, (uint64_t)-9007199254740991, 4, "ABCD");
	put(holding + 20, 9007199254740991u, 4, "DCBA");
	put_double(holding + 24, -0.1, "ABCD");
	put_double(holding + 28, -0.1, "CDAB");
	holding[32] = 0xA5C3;
	input[10] = (uint16_t)-1500;
	input[11] = 64000;
	put_float(input + 12, -273.15f, "ABCD");
	memcpy(registers->tab_registers, holding, sizeof(holding));
	memcpy(registers->tab_input_registers, input, sizeof(input));
}

static unsigned differences(void)
{
	unsigned count = 0;

	for (int at = 0; at < REGISTERS; at++)
		count += (registers->tab_registers[at] != holding[at]) + (registers->tab_input_registers[at] != input[at]);
	return count;
}

static void serve(modbus_t *line)
{
	uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
	unsigned count = 0;

	while (!stopped) {
		int length = modbus_receive(line, request);
		if (length == -1 && errno == ECONNRESET)
			break;
		if (length <= 0) /* nothing yet, spoiled, or for another device */
			continue;
		asked[request[modbus_get_header_length(line)] % CODES]++;
		changed += differences();
		move(++count);
		if (modbus_reply(line, request, length, registers) == -1)
			break;
	}
}

static void report(void)
{
	const char *between = "";

	printf("{\"asked\": {");
	for (int code = 0; code < CODES; code++) {
		if (asked[code] == 0)
			continue;
		printf("%s\"%d\": %lu", between, code, asked[code]);
		between = ", ";
	}
	printf("}, \"changed\": %u}\n", changed + differences());
}

int main(int argc, char **argv)
{
	int tcp = argc == 3 && strcmp(argv[1], "tcp") == 0, listening = -1;
	modbus_t *line;

	if (!tcp && !(argc == 4 && strcmp(argv[1], "rtu") == 0)) {
		fprintf(stderr, "usage: modbus_server tcp PORT | rtu DEVICE BAUDRATE\n");
		return 2;
	}
	/* Without SA_RESTART, so that waiting for a connection ends; waiting for a request does so after LOOK_UP. */
	struct sigaction action = {.sa_handler = stop};
	sigaction(SIGTERM, &action, NULL);

	line = tcp ? modbus_new_tcp("127.0.0.1", atoi(argv[2])) : modbus_new_rtu(argv[2], atoi(argv[3]), 'N', 8, 1);
	registers = modbus_mapping_new(0, 0, REGISTERS, REGISTERS);
	if (line == NULL || registers == NULL || modbus_set_slave(line, DEVICE) == -1)
		goto failed;
	if (modbus_set_indication_timeout(line, 0, LOOK_UP) == -1)
		goto failed;
	move(0);
	if (tcp && (listening = modbus_tcp_listen(line, 1)) == -1)
		goto failed;
	if (!tcp && modbus_connect(line) == -1)
		goto failed;
	printf("serving\n");
	fflush(stdout);
	while (!stopped) {
		if (tcp && modbus_tcp_accept(line, &listening) == -1)
			continue;
		serve(line);
		if (tcp)
			modbus_close(line);
	}
	report();
	if (tcp)
		close(listening);
	modbus_mapping_free(registers);
	modbus_free(line);
	return 0;
failed:
	fprintf(stderr, "modbus_server: %s\n", modbus_strerror(errno));
	return 1;
}
