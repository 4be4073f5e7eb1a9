/* One step of halls with inlet model "approach", for benchmarks/peer.py: the equations of
   kernels/thermal.py for a linear, cubic fan and outlet model "server". Groups of alike servers are
   computed once and copied to their servers; where every server is a group, all are computed. */
#include <stdint.h>

enum { CPU_SLOPE, CPU_OFFSET, CPU_SHIFT, FAN_SLOPE, FAN_OFFSET, FAN_SHIFT, FAN_LOW, FAN_HIGH,
       FAN_RATIO, FAN_EXPONENT, FAN_W, FAN_M3S, AIR, LIMIT_C };

typedef struct { float full_w, idle_w, airflow, airflow_fall_per_k, fan_power; } kind;
typedef struct { float cpu_w, fan_w, flow_m3s, outlet_c; } server;

static inline float larger(float a, float b) { return a > b ? a : b; }
static inline float smaller(float a, float b) { return a < b ? a : b; }

static inline server operate(const float *dc, float inlet_c, float load, kind of)
{
    float t = smaller(inlet_c, dc[LIMIT_C]);
    float ratio = dc[CPU_SLOPE] * t + dc[CPU_OFFSET] + dc[CPU_SHIFT] * load;
    float y = dc[FAN_SLOPE] * t + dc[FAN_OFFSET] + dc[FAN_SHIFT] * load;
    y = smaller(larger(y, dc[FAN_LOW]), dc[FAN_HIGH]);
    float speed = y / dc[FAN_RATIO];
    server s;
    s.cpu_w = larger(of.idle_w, of.full_w * ratio);
    s.fan_w = of.fan_power * dc[FAN_W] * speed * speed * speed;
    s.flow_m3s = dc[FAN_M3S] * y * (of.airflow - of.airflow_fall_per_k * t);
    s.outlet_c = inlet_c + (s.cpu_w + s.fan_w) / (dc[AIR] * s.flow_m3s);
    return s;
}

void hall_step(int32_t n_dcs, int32_t n_groups, const int32_t *rack_start, const int32_t *rack_dc,
               const int32_t *group_start, const int32_t *server_start,
               const float *restrict groups, const float *dcs, const float *approach_k,
               const float *supply_c, const float *loads, float *restrict racks, double *sums,
               float *restrict inlet_c, float *restrict outlet_c, float *restrict power_w)
{
    const float *full_w = groups + n_groups, *idle_w = groups + 2L * n_groups;
    const float *offset_k = groups + 3L * n_groups, *deviation = groups + 4L * n_groups;
    const float *airflow = groups + 6L * n_groups, *fall_per_k = groups + 7L * n_groups;
    const float *fan_power = groups + 8L * n_groups;
    int each_its_own = server_start[n_groups] == n_groups;
    #pragma omp parallel for schedule(static)
    for (int32_t r = 0; r < rack_start[n_dcs]; r++) {
        int32_t d = rack_dc[r];
        float dc[LIMIT_C + 1];
        for (int i = 0; i <= LIMIT_C; i++) dc[i] = dcs[18L * d + i];
        float air_c = supply_c[d] + approach_k[r], u = loads[d], spread = u * (1.0f - u);
        float cpu = 0, fan = 0, flow = 0, inlet = 0, outlet = 0, hottest = -1e30f;
        if (each_its_own) {
            #pragma omp simd reduction(+ : cpu, fan, flow, inlet, outlet) reduction(max : hottest)
            for (int32_t g = group_start[r]; g < group_start[r + 1]; g++) {
                float t = air_c + offset_k[g];
                kind of = { full_w[g], idle_w[g], airflow[g], fall_per_k[g], fan_power[g] };
                server s = operate(dc, t, u + deviation[g] * spread, of);
                inlet_c[g] = t; outlet_c[g] = s.outlet_c; power_w[g] = s.cpu_w + s.fan_w;
                cpu += s.cpu_w; fan += s.fan_w; flow += s.flow_m3s;
                inlet += t; outlet += s.flow_m3s * s.outlet_c; hottest = larger(hottest, t);
            }
        } else for (int32_t g = group_start[r]; g < group_start[r + 1]; g++) {
            float t = air_c + offset_k[g], count = groups[g];
            kind of = { full_w[g], idle_w[g], airflow[g], fall_per_k[g], fan_power[g] };
            server s = operate(dc, t, u + deviation[g] * spread, of);
            float drawn_w = s.cpu_w + s.fan_w;
            for (int32_t i = server_start[g]; i < server_start[g + 1]; i++) {
                inlet_c[i] = t; outlet_c[i] = s.outlet_c; power_w[i] = drawn_w;
            }
            cpu += count * s.cpu_w; fan += count * s.fan_w; flow += count * s.flow_m3s;
            inlet += count * t; outlet += count * s.flow_m3s * s.outlet_c;
            hottest = larger(hottest, t);
        }
        float servers = server_start[group_start[r + 1]] - server_start[group_start[r]];
        float *rack = racks + 6L * r;
        rack[0] = cpu; rack[1] = fan; rack[2] = flow;
        rack[3] = inlet / servers; rack[4] = hottest; rack[5] = outlet / flow;
    }
    #pragma omp parallel for schedule(static)
    for (int32_t d = 0; d < n_dcs; d++) {
        double cpu = 0, fan = 0, flow = 0;
        for (int32_t r = rack_start[d]; r < rack_start[d + 1]; r++) {
            cpu += racks[6L * r]; fan += racks[6L * r + 1]; flow += racks[6L * r + 2];
        }
        sums[3L * d] = cpu; sums[3L * d + 1] = fan; sums[3L * d + 2] = flow;
    }
}
