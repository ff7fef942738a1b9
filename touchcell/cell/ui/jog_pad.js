// Buttons and keys that move an arm by hand. What is held is sent every 30 ms with the newest stamp of the server, which
// is how old the run takes it to be: nothing that happens to this page keeps an arm moving.
const AXES = ["x", "y", "z", "rx", "ry", "rz"];
const KEYS = ["u", "j", "i", "k", "o", "l", "U", "J", "I", "K", "O", "L"];
const SHARES = [0.02, 0.1, 0.2, 0.5, 1.0];
const STEPS_MM = [0.1, 0.5, 1.0, 2.0, 5.0];
const PERIOD_MS = 30;
const STEP_HELD_MS = 1000;

export default {
  template: `
  <div class="w-full" style="touch-action: manipulation">
    <div class="row items-center q-gutter-xs q-mb-xs">
      <q-btn-toggle v-if="arms.length > 1" v-model="arm" dense no-caps toggle-color="primary"
        :options="arms.map(each => ({label: each, value: each}))" @update:model-value="letGo" />
      <q-btn-toggle v-model="frame" dense no-caps toggle-color="primary"
        :options="['base', 'tool', 'contact'].map(each => ({label: each, value: each}))" @update:model-value="letGo" />
      <q-btn-toggle v-model="mode" dense no-caps toggle-color="primary" @update:model-value="letGo"
        :options="[{label: 'hold', value: 'free'}, {label: 'step', value: 'step'},
                   {label: 'until touch', value: 'until touch'}]" />
    </div>
    <div class="row items-center q-gutter-sm no-wrap q-mb-xs">
      <span style="min-width: 6.5em">{{ mode === 'step' ? steps[step] + ' mm, deg' : 100 * shares[share] + ' %' }}</span>
      <q-slider v-if="mode === 'step'" v-model="step" :min="0" :max="4" snap markers />
      <q-slider v-else v-model="share" :min="0" :max="4" snap markers />
    </div>
    <div v-for="group in [0, 1]" :key="group" class="row no-wrap q-mb-xs" style="gap: 6px">
      <div v-for="axis in 3" :key="axis" class="col column" style="gap: 4px">
        <q-btn v-for="sign in [0, 1]" :key="sign" unelevated no-caps :ripple="false" class="jog-button"
          style="touch-action: none; user-select: none; -webkit-user-select: none; min-height: 44px"
          :color="held === 6 * group + 2 * (axis - 1) + sign ? 'orange' : 'blue-grey-1'" text-color="black"
          :data-jog="names[3 * group + axis - 1] + (sign ? '-' : '+')"
          :label="names[3 * group + axis - 1] + (sign ? ' −' : ' +')"
          @pointerdown.prevent="press(6 * group + 2 * (axis - 1) + sign, $event)"
          @pointerup="letGo" @pointerleave="letGo" @pointercancel="letGo" @contextmenu.prevent />
      </div>
    </div>
    <div class="row items-center q-gutter-xs">
      <q-btn no-caps unelevated :ripple="false" label="back off" data-jog="retract"
        style="touch-action: none; user-select: none" text-color="black"
        :color="held === 'retract' ? 'orange' : 'blue-grey-1'" @pointerdown.prevent="press('retract', $event)"
        @pointerup="letGo" @pointerleave="letGo" @pointercancel="letGo" @contextmenu.prevent />
      <q-btn no-caps flat label="zero" @click="zero" />
      <q-input v-model="name" dense placeholder="start, corner, a step …" style="width: 11em"
        @keydown.stop @keyup.stop @focus="letGo" maxlength="40" />
      <q-btn no-caps flat label="save" :disable="!name" @click="save" />
    </div>
    <div class="text-caption text-mono q-mt-xs" style="min-height: 3.6em; white-space: pre-wrap">{{ line }}</div>
    <div class="text-caption text-grey-7">
      Moves while it is held. Keys: u j, i k, o l and with Shift, b backs off; space stops at once.
    </div>
  </div>`,
  props: { run: String, arms: Array },
  data() {
    return {
      arm: this.arms[0], frame: "base", mode: "free", share: 2, step: 2, held: null, name: "", names: AXES,
      steps: STEPS_MM, shares: SHARES, line: "connecting …", shown: {},
    };
  },
  mounted() {
    this.seq = 0;
    this.stamp = null;
    this.heldKey = null;
    this.handlers = [
      [window, "blur", () => this.letGo()],
      [window, "pagehide", () => this.letGo()],
      [document, "visibilitychange", () => this.letGo()],
      [window, "keydown", event => this.keyDown(event)],
      [window, "keyup", event => this.keyUp(event)],
    ];
    this.handlers.forEach(([target, kind, handler]) => target.addEventListener(kind, handler));
    this.connect();
    this.timer = setInterval(() => this.send(), PERIOD_MS);
  },
  unmounted() {
    this.gone = true;
    clearInterval(this.timer);
    this.handlers.forEach(([target, kind, handler]) => target.removeEventListener(kind, handler));
    if (this.socket) this.socket.close();
  },
  methods: {
    connect() {
      const scheme = location.protocol === "https:" ? "wss" : "ws";
      this.socket = new WebSocket(`${scheme}://${location.host}/jog/${encodeURIComponent(this.run)}`);
      this.socket.onmessage = event => {
        const data = JSON.parse(event.data);
        if (data.stamp) this.stamp = data.stamp;
        if (data.shown) {
          this.shown = data.shown;
          this.describe();
        }
      };
      this.socket.onclose = () => {
        this.letGo();
        this.stamp = null;
        this.line = "not connected: nothing moves";
        if (!this.gone) setTimeout(() => this.gone || this.connect(), 1000);
      };
    },
    describe() {
      const { state, reason, where, message } = this.shown;
      const first = `${state.replaceAll("_", " ")}  ${(where || {})[this.arm] || ""}`;
      this.line = [first, reason, message].filter(Boolean).join("\n");
    },
    deflection(key) {
      const axes = [0, 0, 0, 0, 0, 0];
      axes[key >> 1] = key % 2 ? -1 : 1;
      return axes;
    },
    request() {
      if (this.held === null) return null;
      if (this.held === "zero") return { arm: this.arm, mode: "zero", axes: [0, 0, 0, 0, 0, 0] };
      const share = SHARES[this.share];
      if (this.held === "retract") return { arm: this.arm, mode: "retract", axes: [0, 0, 0, 0, 0, 0], share };
      const mm = STEPS_MM[this.step];
      return {
        arm: this.arm, mode: this.mode, axes: this.deflection(this.held), frame: this.frame,
        share: this.mode === "step" ? 1 : share, step_m: mm / 1000, step_rad: mm * Math.PI / 180,
      };
    },
    send(more) {
      if (!this.socket || this.socket.readyState !== WebSocket.OPEN) return;
      // What the network has not taken yet would arrive late.
      if (this.socket.bufferedAmount > 4096) return;
      if (this.stepUntil && performance.now() > this.stepUntil) this.end();
      this.socket.send(JSON.stringify({ stamp: this.stamp, seq: this.seq, request: this.request(), ...more }));
    },
    press(what, event) {
      if (event && event.button) return;
      if (event && event.target.hasPointerCapture && event.target.hasPointerCapture(event.pointerId))
        event.target.releasePointerCapture(event.pointerId);
      if (this.held !== null) this.end();
      this.held = what;
      this.seq += 1;
      this.stepUntil = this.isStep(what) ? performance.now() + STEP_HELD_MS : null;
      this.send();
    },
    isStep(what) {
      return what === "zero" || (this.mode === "step" && typeof what === "number");
    },
    letGo(event) {
      // A step ends by itself; a page that is left does not wait for that.
      const left = !(event && event.type && event.type.startsWith("pointer"));
      if (this.held === null || (this.stepUntil && !left)) return;
      this.end();
    },
    end() {
      this.held = this.heldKey = this.stepUntil = null;
      this.send();
    },
    zero() {
      this.press("zero");
    },
    save() {
      if (!window.confirm(`Write the pose of ${this.arm} as "${this.name}" into the cell file?`)) return;
      this.send({ save: this.name, save_arm: this.arm });
      this.name = "";
    },
    keyDown(event) {
      if (event.target.closest && event.target.closest("input, textarea")) return;
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      if (event.key === " ") {
        event.preventDefault();
        this.end();
        this.send({ stop: "at once" });
        return;
      }
      const what = event.key === "b" ? "retract" : KEYS.indexOf(event.key);
      if (what === -1) {
        this.letGo();
        return;
      }
      event.preventDefault();
      if (event.repeat || this.held === what) return;
      this.press(what);
      this.heldKey = event.code;
    },
    keyUp(event) {
      if (this.heldKey === event.code && !this.stepUntil) this.end();
    },
  },
};
